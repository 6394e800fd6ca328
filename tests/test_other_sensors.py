"""Scans of nuScenes and Argoverse 2: files, layouts, splits, and the real ones, an Ouster's too."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lidargrit.core.errors import DataError, OutputError, ScanError
from lidargrit.data.datasets import load, open_dataset
from lidargrit.data.formats import count_scans, read_scan
from lidargrit.data.formats import load as load_format
from lidargrit.scans.projection import project
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import Scan
from lidargrit.simulator import simulate

# x right, y forward, z up, intensity, laser from the lowest
SWEEP = np.array([[3, 40, 1, 255, 31], [-5, 2, -1, 51, 0], [0.1, -0.4, 0.2, 7, 3]], dtype="<f4")
NAME = "n008-2018-08-01-15-16-36-0400__LIDAR_TOP__{}.pcd.bin"


def put(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.tobytes())
    return path


def one_line(refusal) -> str:
    assert "\n" not in str(refusal.value)
    return str(refusal.value)


# Files of nuScenes.


def test_nuscenes_axes_are_turned_rings_counted_from_the_top_and_near_points_left_out(tmp_path):
    scan = read_scan(put(tmp_path / "a.pcd.bin", SWEEP))
    assert scan.points_xyz_m.tolist() == [[40, -3, 1], [2, 5, -1]], "x forward, y left"
    assert scan.ring.tolist() == [0, 31]
    assert torch.allclose(scan.reflectance, torch.tensor([1.0, 0.2]))


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"", "an empty file"),
        (bytes(33), "33 bytes in .*, 13 more than whole points; .*download it again"),
        (bytes(32), "32 bytes in .*; if its rows are x, y, z, reflectance, as KITTI writes them, name it .bin"),
        (SWEEP[:, [0, 1, 2, 3, 0]], "laser numbers other than 0 to 31"),
        (SWEEP * np.float32([1, 1, 1, 2, 1]), "reflectance from 0.4 to 2 in"),
        (SWEEP * np.float32([np.nan, 1, 1, 1, 1]), "3 of 3 points with NaN or infinite"),
        (SWEEP[2:], "no point in"),
        (SWEEP * np.float32([np.inf, 1, 1, 1, 1]), "3 of 3 points with NaN or infinite"),
    ],
)
def test_nuscenes_files_that_are_refused(tmp_path, content, text):
    path = put(tmp_path / "a.pcd.bin", content)
    with pytest.raises(ScanError, match=text) as refusal:
        read_scan(path)
    assert str(path) in one_line(refusal)


def test_nuscenes_coordinates_whose_squares_are_too_large_are_far(tmp_path):
    path = put(tmp_path / "a.pcd.bin", SWEEP[:2] * np.float32([1e37, 1, 1, 1, 1]))
    assert read_scan(path).points_xyz_m[:, 1].tolist() == pytest.approx([-3e37, 5e37])


@pytest.mark.parametrize(
    ("name", "sensor", "tolerance_m"), [("nuscenes_bin", "hdl32e", 1e-5), ("argoverse_feather", "vlp32c", 0.05)]
)
def test_what_is_written_is_read_again(tmp_path, name, sensor, tolerance_m):
    form, written = load_format(name), simulate(3, load_sensor(sensor).with_columns(300))
    near = written.points_xyz_m.norm(dim=1) < 60
    written = Scan(written.points_xyz_m[near], written.reflectance[near], written.ring[near])
    path = tmp_path / f"a{form.suffixes[0]}"
    form.write(path, written)
    assert form.recognises(path)
    read = read_scan(path)
    assert (read.points_xyz_m - written.points_xyz_m).abs().max() < tolerance_m
    assert torch.equal(read.ring, written.ring)
    assert (read.reflectance - written.reflectance).abs().max() <= 0.5 / 255 + 1e-6
    for ring in (None, written.ring + 1):
        with pytest.raises(OutputError, match=r"(no|other) rings; wanted rings from 0 to 31"):
            form.write(tmp_path / "b", replace(written, ring=ring))
    assert not (tmp_path / "b").exists()


# Scenes and splits of nuScenes.


@pytest.fixture
def nuscenes(tmp_path):
    """Two scenes of one log 10 s apart, one of another, with keyframes, sweeps between them, and the tables."""
    root, seconds = tmp_path / "nuscenes", 1_000_000
    scenes = {"scene-0001": ("n1", 100), "scene-0003": ("n1", 130), "scene-0077": ("n2", 100)}
    tables = {"scene": [], "sample": [], "log": [{"token": f"t{log}", "logfile": log} for log in ("n1", "n2")]}
    for name, (log, start) in scenes.items():
        tables["scene"].append({"token": f"s{name}", "log_token": f"t{log}", "name": name, "description": "rain"})
        for half in range(4):
            time = start * seconds + half * seconds // 2
            tables["sample"].append({"token": f"{name}{half}", "timestamp": time, "scene_token": f"s{name}"})
            for kind, later in (("samples", 0), ("sweeps", 50_000), ("sweeps", 100_000)):
                put(root / kind / "LIDAR_TOP" / f"{log}__LIDAR_TOP__{time + later}.pcd.bin", SWEEP)
    for table, rows in tables.items():
        put(root / "v1.0-trainval" / f"{table}.json", json.dumps(rows).encode())
    return root


def test_nuscenes_sweeps_are_sorted_by_time_and_told_by_scene(nuscenes):
    dataset = open_dataset(str(nuscenes))
    assert (dataset.public_name(), len(dataset)) == ("nuscenes", 36)
    names = [dataset.name(index) for index in range(36)]
    assert names == sorted(names)
    assert names[:3] == ["n1__LIDAR_TOP__100000000", "n1__LIDAR_TOP__100050000", "n1__LIDAR_TOP__100100000"]
    for split, first in (
        ("train", "n1__LIDAR_TOP__100"),
        ("val", "n1__LIDAR_TOP__130"),
        ("test", "n2__LIDAR_TOP__100"),
    ):
        for written in (split, f"official/{split}"):
            part = open_dataset(f"nuscenes:{nuscenes}:{written}")
            assert len(part) == 12
            assert all(part.name(index)[:-6] >= first for index in range(12))
    assert open_dataset(f"{nuscenes}:scene-0003").recording(0) == dataset.recording(0) == "nuscenes/n1"
    with pytest.raises(
        DataError, match=r"none of whose sequences is there; wanted a sequence among scene-0061, .*, \.\.\."
    ):
        open_dataset(f"{nuscenes}:mini_train")


def test_nuscenes_sweeps_of_no_scene_belong_to_their_log(nuscenes):
    put(nuscenes / "sweeps" / "LIDAR_TOP" / "n1__LIDAR_TOP__115000000.pcd.bin", SWEEP)
    assert open_dataset(f"{nuscenes}:n1").name(0) == "n1__LIDAR_TOP__115000000"
    assert len(open_dataset(f"{nuscenes}:train+val")) == 24


def test_nuscenes_without_tables_goes_by_logs_and_says_what_splits_need(nuscenes):
    shutil.rmtree(nuscenes / "v1.0-trainval")
    assert len(open_dataset(f"{nuscenes}:n1")) == 24
    with pytest.raises(DataError, match=r"'train' .* without the tables .*; wanted scene.json.*choose logs: n1\+n2"):
        open_dataset(f"{nuscenes}:train")
    flat = open_dataset(str(nuscenes / "samples" / "LIDAR_TOP"))
    assert (flat.public_name(), flat.recording(0)) == ("nuscenes", "nuscenes/n1")


@pytest.mark.parametrize("text", ["", "{", "[1]", '[{"token": []}]', "[" * 100_000, "null", '[{"timestamp": 1e999}]'])
@pytest.mark.parametrize("table", ["scene", "sample", "log"])
def test_nuscenes_with_damaged_tables_is_refused_in_one_line(nuscenes, table, text):
    (nuscenes / "v1.0-trainval" / f"{table}.json").write_text(text)
    with pytest.raises(DataError, match="whose tables cannot be used") as refusal:
        open_dataset(str(nuscenes))
    assert len(one_line(refusal)) < 600


def test_nuscenes_official_scenes_are_a_thousand_and_in_one_split_each():
    parts = {name: set(scenes) for name, scenes in load("nuscenes").schemes["official"].parts.items()}
    assert (len(parts["val"]), len(parts["test"])) == (150, 150)
    for one, other in (("train", "val"), ("train", "test"), ("val", "test")):
        assert not parts[one] & parts[other]
    assert parts["mini_train"] - parts["train"] == {"scene-0553", "scene-0796"}, "as the note on leaks says"
    assert parts["mini_val"] <= parts["val"]


# Argoverse 2.


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """A sweep of both sensors, each of which sees 30 points a laser at its elevations, in the car's frame."""
    pa = pytest.importorskip("pyarrow")
    from pyarrow import feather

    def write(path, up_deg=None, numbers=None, **changed):
        table = load_sensor("vlp32c").elevation_rad[:, 0].double().numpy()
        columns = {name: [] for name in ("x", "y", "z", "intensity", "laser_number", "offset_ns")}
        for first, elevations, origin in ((0, table, (1.35, 0, 1.64)), (32, -table, (1.36, 0, 1.57))):
            for number, elevation in enumerate(elevations):
                azimuth = np.linspace(-3.1, 3.1, 30)
                ray = np.stack(
                    (
                        np.cos(elevation) * np.cos(azimuth),
                        np.cos(elevation) * np.sin(azimuth),
                        np.sin(elevation) + 0 * azimuth,
                    )
                )
                for name, values in zip("xyz", 20 * ray + np.array(origin)[:, None], strict=True):
                    columns[name] += values.tolist()
                own = number if numbers is None else numbers[number]
                columns["laser_number"] += [first + own] * 30
                columns["intensity"] += [number * 8] * 30
                columns["offset_ns"] += [0] * 30
        kinds = {"x": "f2", "y": "f2", "z": "f2", "intensity": "u1", "laser_number": "u1", "offset_ns": "i4"}
        table = {name: np.array(values, kinds[name]) for name, values in columns.items()} | changed
        path.parent.mkdir(parents=True, exist_ok=True)
        feather.write_feather(
            pa.table({name: values for name, values in table.items() if values is not None}), str(path)
        )
        return path

    return write


@pytest.mark.parametrize("scrambled", [False, True])
def test_argoverse_has_a_scan_of_each_sensor_with_rings_from_the_top(tmp_path, sweep, scrambled):
    numbers = np.random.default_rng(0).permutation(32) if scrambled else None
    path = sweep(tmp_path / "1.feather", numbers=numbers)
    assert count_scans(path) == 2
    table_deg = load_sensor("vlp32c").elevation_rad[:, 0].rad2deg()
    for index, wanted_deg in ((0, table_deg), (1, -table_deg.flip(0))):
        scan = read_scan(path, index)
        x, y, z = scan.points_xyz_m.T
        elevation_deg = torch.atan2(z, torch.hypot(x, y)).rad2deg()
        assert (elevation_deg - wanted_deg[scan.ring]).abs().max() < 0.1
        assert scan.ring.bincount().tolist() == [30] * 32
    with pytest.raises(ScanError, match=r"scan number 2 of .*; wanted one of its 2"):
        read_scan(path, 2)


def test_argoverse_takes_the_poses_of_the_log(tmp_path, sweep):
    import pyarrow as pa
    from pyarrow import feather

    path = sweep(tmp_path / "log" / "sensors" / "lidar" / "1.feather")
    nominal = read_scan(path)
    poses = {"sensor_name": ["ring_front_left", "up_lidar", "down_lidar"]}
    poses |= {"qw": [1.0, np.cos(0.5), 0.0], "qx": [0.0, 0.0, 1.0], "qy": [0.0] * 3, "qz": [0.0, np.sin(0.5), 0.0]}
    poses |= {"tx_m": [0.0, 2.35018, 0.0], "ty_m": [0.0] * 3, "tz_m": [0.0, 1.64042, 0.0]}
    calibration = tmp_path / "log" / "calibration" / "egovehicle_SE3_sensor.feather"
    calibration.parent.mkdir()
    feather.write_feather(pa.table(poses), str(calibration))
    moved = read_scan(path)
    # the sensor is turned about its axis, which leaves x towards the car's front, and stands 1 m further ahead
    assert torch.allclose(moved.points_xyz_m, nominal.points_xyz_m - torch.tensor([1.0, 0, 0]), atol=1e-3)
    for wrong in ({"qw": [1.0, 7.0, 0.0]}, {"tx_m": [0.0, np.nan, 0.0]}, {"sensor_name": ["a", "b", "c"]}):
        feather.write_feather(pa.table(poses | wrong), str(calibration))
        with pytest.raises(ScanError, match=r"no pose of up_lidar on a car in .*egovehicle_SE3_sensor"):
            read_scan(path)
    calibration.write_bytes(b"no table")
    with pytest.raises(ScanError, match=r"egovehicle_SE3_sensor\.feather, which cannot be used") as refusal:
        read_scan(path)
    one_line(refusal)


def test_argoverse_files_that_are_refused(tmp_path, sweep):
    count = 64 * 30
    for changed, text in [
        ({"z": None}, "no column z"),
        ({"x": np.array(["a"] * count)}, "string in the column x|large_string in the column x"),
        ({"laser_number": np.full(count, 64, "u1")}, "no point of up_lidar"),
        ({"x": np.full(count, np.nan, "f2")}, "points with NaN or infinite"),
    ]:
        path = sweep(tmp_path / "a.feather", **changed)
        with pytest.raises(ScanError, match=text) as refusal:
            read_scan(path)
        assert str(path) in one_line(refusal)
    for content in (b"", b"ARROW1\0\0", b"no arrow at all", path.read_bytes()[:900]):
        with pytest.raises(ScanError, match=r"a\.feather") as refusal:
            read_scan(put(path, content))
        one_line(refusal)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 0])
def test_argoverse_points_that_are_none_do_not_move_the_rings_of_others(tmp_path, sweep, bad):
    whole = read_scan(sweep(tmp_path / "a.feather"))
    columns = {axis: np.float16(1) * read_columns(tmp_path / "a.feather")[axis] for axis in "xyz"}
    for values in columns.values():
        values[: 10 * 30 : 2] = bad  # half of the points of ten lasers
        values[31 * 30 : 32 * 30] = bad  # all of one's
    path = sweep(tmp_path / "b.feather", **columns)
    with pytest.raises(ScanError, match=r"180 of 960 points (with NaN or infinite coordinates|at the origin)"):
        read_scan(path)
    left, kept = read_scan(path, bad_points="drop"), np.isfinite(columns["x"][:960]) & (columns["x"][:960] != 0)
    assert torch.equal(left.ring, whole.ring[torch.from_numpy(kept)])


def read_columns(path):
    from pyarrow import feather

    return {name: column.to_numpy() for name, column in zip("xyz", feather.read_table(path).columns, strict=False)}


def test_argoverse_refuses_a_file_that_unpacks_to_more_than_any_sweep(tmp_path):
    pa = pytest.importorskip("pyarrow")
    from pyarrow import feather

    zeros = np.zeros(15_000_000, "f8")  # 360 MB that pack into far less than a sweep's own size
    path = tmp_path / "bomb.feather"
    feather.write_feather(
        pa.table(dict.fromkeys("xyz", zeros) | dict.fromkeys(("intensity", "laser_number"), zeros[:].view("u8"))),
        str(path),
        compression="zstd",
    )
    assert path.stat().st_size < 3_000_000
    with pytest.raises(ScanError, match="far more points than a scan has"):
        read_scan(path)


def scan_or_refusal(path) -> Scan | ScanError:
    try:
        return read_scan(path)
    except ScanError as refusal:
        return refusal


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_argoverse_of_damaged_bytes_is_a_scan_or_one_line(tmp_path_factory, sweep, data):
    path = tmp_path_factory.getbasetemp() / "fuzz.feather"
    content = bytearray(sweep(path).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1) | st.integers(0, 1500))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(0, len(content)) | st.just(len(content)))])
    found = scan_or_refusal(path)
    assert found.ring is not None if isinstance(found, Scan) else str(path) in found.got and "\n" not in str(found)


def test_argoverse_logs_are_sequences_and_only_the_upright_sensor_is_taken(tmp_path, sweep):
    for log_folder in ("train/a", "train/b", "val/c"):
        sweep(tmp_path / "av2" / log_folder / "sensors" / "lidar" / "7.feather")
    names = {}
    for split in ("all", "train", "val", "train/b"):
        dataset = open_dataset(f"{tmp_path / 'av2'}:{split}")
        names[split] = [dataset.name(index) for index in range(len(dataset))]
    assert names["all"] == ["train/a/7", "train/b/7", "val/c/7"]
    assert (names["train"], names["val"], names["train/b"]) == (names["all"][:2], names["all"][2:], ["train/b/7"])
    with pytest.raises(DataError, match=r"'test' .*none of whose sequences is there; wanted a sequence among test/\*"):
        open_dataset(f"{tmp_path / 'av2'}:test")
    log = open_dataset(str(tmp_path / "av2" / "train" / "a"))
    assert (log.public_name(), log.recording(0)) == ("argoverse2", "argoverse2/a")
    assert open_dataset(f"{tmp_path / 'av2'}:train").recording(0) == "argoverse2/a"


# Real files.


def elevation_deg(scan: Scan) -> torch.Tensor:
    return torch.atan2(scan.points_xyz_m[:, 2], scan.points_xyz_m[:, :2].norm(dim=1)).rad2deg()


@pytest.mark.shared
@pytest.mark.parametrize(
    ("folder", "index", "points", "off_deg", "filled"),
    [
        ("nuscenes_hdl32e", 0, 20766, 0.25, 0.58),
        ("nuscenes_hdl32e", 1, 26659, 0.15, 0.74),
        ("argoverse2_2xvlp32c", 0, 51785, 0.03, 0.87),
        ("ouster", 0, 107647, 0.07, 0.82),
        ("ouster", 2, 107532, 0.07, 0.82),
    ],
)
def test_real_scans_have_the_rings_of_their_sensor(real, folder, index, points, off_deg, filled):
    dataset = open_dataset(str(real / "other_sensors" / folder))
    scan, sensor = dataset.scan(index), load_sensor(dataset.sensor)
    assert len(scan) == points
    elevations = elevation_deg(scan)
    medians = torch.stack([elevations[scan.ring == row].median() for row in range(sensor.height)])
    assert (medians - sensor.elevation_rad[:, 0].rad2deg()).abs().max() < off_deg
    image = project(scan, sensor, "unfolding")
    assert image.return_mask.float().mean() == pytest.approx(filled, abs=0.01)
    below = image.range_m[-sensor.height // 4 :][image.return_mask[-sensor.height // 4 :]]
    above = image.range_m[: sensor.height // 4][image.return_mask[: sensor.height // 4]]
    assert below.median() < above.median(), "the ground is near, and below"


@pytest.mark.shared
def test_real_nuscenes_streets_are_not_mirrored(real):
    """In Boston (n008) one drives on the right, in Singapore (n015) on the left: that kerb is the nearer one."""
    dataset = load("nuscenes")(real / "other_sensors" / "nuscenes_hdl32e")
    for index, nearer_is_left in ((0, False), (1, True)):
        x, y, z = dataset.scan(index).points_xyz_m.T
        beside = (x.abs() < 6) & (z > -1.2) & (z < 2)
        left_m, right_m = y[beside & (y > 2.5)].min(), -y[beside & (y < -2.5)].max()
        assert bool(left_m < right_m) == nearer_is_left, (index, left_m, right_m)


@pytest.mark.shared
def test_real_argoverse_sensor_upside_down_is_a_vlp32c_turned_over(real):
    (path,) = (real / "other_sensors" / "argoverse2_2xvlp32c").glob("*")
    scan = read_scan(path, 1)
    wanted_deg, elevations = -load_sensor("vlp32c").elevation_rad[:, 0].flip(0).rad2deg(), elevation_deg(scan)
    off_deg = torch.stack([elevations[scan.ring == row].median() for row in range(32)]) - wanted_deg
    assert off_deg.abs().max() < 0.3, "the published example's pose, not that of this log"
    assert off_deg.std() < 0.05
    spread_deg = torch.stack([elevations[scan.ring == row].std() for row in range(32)])
    assert spread_deg.mean() < 0.12
