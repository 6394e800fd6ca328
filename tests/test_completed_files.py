"""Files of completed clouds: what is kept of each, what is read back and seen, and input that is none."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from clouds_of_streets import DENSE, SIXTEEN, street
from lidargrit.cli import main
from lidargrit.data import formats
from lidargrit.data.formats import read_scan
from lidargrit.data.formats.kitti_bin import KittiBin
from lidargrit.data.formats.pcd import Pcd
from lidargrit.data.prepared.config import ScanSettings
from lidargrit.inference.complete import open_model
from lidargrit.inference.complete.cloud import CompletedScan
from lidargrit.inference.complete.clouds_to_files import write_cloud
from lidargrit.inference.complete.tasks import complete_scan
from lidargrit.scans.projection import unproject
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import Scan
from lidargrit.viewer.scan_sets import load_scan_sets


def columns_of_file(scan: Scan) -> dict:
    return {name: np.asarray(values) for name, values in scan.rows.columns.items()}


def put_pcd(path, with_nan: bool = False) -> dict:
    """Write a driver's PCD: intensity to 255, rings from the bottom, times in 64 bits, and a placeholder."""
    scan = unproject(street(SIXTEEN))
    columns = {axis: scan.points_xyz_m[:, at].numpy().copy() for at, axis in enumerate("xyz")}
    if with_nan:
        columns["x"][5] = columns["y"][5] = columns["z"][5] = np.nan
    columns["intensity"] = (255 * scan.reflectance).round().numpy()
    columns["ring"] = (15 - scan.ring).numpy().astype(np.uint16)
    columns["timestamp"] = 1.6e9 + np.arange(len(scan)) * 1e-6
    columns["return_type"] = (np.arange(len(scan)) % 3).astype(np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    Pcd.write_columns(path, columns)
    return columns


def test_a_file_keeps_all_its_rows_and_columns_bit_for_bit(tmp_path):
    before = put_pcd(tmp_path / "in/a.pcd", with_nan=True)
    words = ["upsample", f"{tmp_path}/in", f"{tmp_path}/out", "--sensor", "vlp16", "--to", "pandar64"]
    assert main([*words, "--model", "nearest", "--bad-points", "drop"]) == 0
    after = columns_of_file(read_scan(tmp_path / "out/a.pcd", bad_points="drop"))
    count = len(before["x"])
    assert set(after) == {*before, "filled"}
    for name, values in before.items():
        assert after[name][:count].tobytes() == values.tobytes(), name
        assert after[name].dtype == values.dtype
    assert not after["filled"][:count].any()
    assert after["filled"][count:].all()
    assert len(after["x"]) > 1.5 * count
    assert after["ring"].max() == 15
    assert set(after["timestamp"]) <= set(before["timestamp"]), "of the nearest measured point"
    assert 0 < after["intensity"][count:].max() <= 255


def test_time_and_other_columns_go_into_another_format(tmp_path):
    before = put_pcd(tmp_path / "in/a.pcd")
    words = [
        "upsample",
        f"{tmp_path}/in",
        f"{tmp_path}/out",
        "--sensor",
        "vlp16",
        "--to",
        "pandar64",
        "--format",
        "npz",
    ]
    assert main([*words, "--model", "nearest"]) == 0
    with np.load(tmp_path / "out/a.npz") as after:
        count = len(before["x"])
        assert np.array_equal(after["points"][:count], np.stack([before[axis] for axis in "xyz"], 1))
        assert np.array_equal(after["timestamp"][:count], before["timestamp"])
        assert after["filled"].sum() == len(after["points"]) - count > 0


@pytest.mark.parametrize("ending", [".bin", ".npy", ".npz", ".ply", ".csv", ".pcd"])
def test_own_output_is_read_back_and_seen_without_loss(ending, tmp_path, capsys):
    scan = unproject(street(DENSE.fine()))
    fired = torch.argsort(
        scan.ring * 10 + torch.atan2(scan.points_xyz_m[:, 1], scan.points_xyz_m[:, 0]) % (2 * math.pi)
    )
    scan = Scan(scan.points_xyz_m[fired], scan.reflectance[fired], scan.ring[fired])
    (tmp_path / "sensor.json").write_text(json.dumps(DENSE.fine().to_json()))
    next(one for one in formats.candidates(tmp_path / f"a{ending}")).write(tmp_path / f"in/a{ending}", scan)
    before = read_scan(tmp_path / f"in/a{ending}")
    words = ["complete", f"{tmp_path}/in", f"{tmp_path}/out", "--model", "triangulation"]
    assert main([*words, "--sensor", f"{tmp_path}/sensor.json"]) == 0
    told = capsys.readouterr().out
    after = read_scan(tmp_path / f"out/a{ending}")
    assert torch.equal(after.points_xyz_m[: len(before)], before.points_xyz_m)
    assert torch.equal(after.reflectance[: len(before)], before.reflectance)
    filled = len(after) - len(before)
    assert after.filled.tolist() == [False] * len(before) + [True] * filled
    assert f"{len(after):,} points, {len(before):,} measured and {filled:,} filled" in told
    assert f"lidargrit view {tmp_path}/out" in told
    (shown,) = load_scan_sets([f"{tmp_path}/out"], 1, settings=ScanSettings(), all_columns=True)
    assert int(shown.images.return_mask.sum()) == len(after), "each point has a pixel of its own"
    assert int(shown.filled.sum()) == filled
    assert main(["view", f"{tmp_path}/out", "-o", f"{tmp_path}/v.html"]) == 0
    assert main(["view", f"{tmp_path}/out", "-o", f"{tmp_path}/v.png"]) == 0
    assert "WARNING" not in capsys.readouterr().err
    assert '"filled"' in (tmp_path / "v.html").read_text()


def test_marks_that_do_not_fit_are_refused(tmp_path):
    KittiBin.write(tmp_path / "a.bin", unproject(street(DENSE)))
    (tmp_path / "a.filled").write_bytes(b"\1\0")
    with pytest.raises(formats.ScanError, match=r"2 bytes up to 1 in .*a.filled; wanted a byte of 0 or 1 for each"):
        read_scan(tmp_path / "a.bin")


def test_nuscenes_keeps_its_own_file_with_the_rows_that_are_no_points(tmp_path):
    sensor = load_sensor("hdl32e")
    scan = unproject(street(sensor.with_columns(256)))
    form = formats.load("nuscenes_bin")
    form.write(tmp_path / "in/a.pcd.bin", scan)
    rows = np.fromfile(tmp_path / "in/a.pcd.bin", "<f4").reshape(-1, 5)
    rows[7, :3] = (0.1, 0.2, 0.05)  # a beam that did not return
    rows.tofile(tmp_path / "in/a.pcd.bin")
    words = ["upsample", f"{tmp_path}/in", f"{tmp_path}/out", "--to", "pandar64", "--model", "nearest"]
    assert main([*words, "--sensor", "hdl32e"]) == 0
    after = np.fromfile(tmp_path / "out/a.pcd.bin", "<f4").reshape(-1, 5)
    assert after[: len(rows)].tobytes() == rows.tobytes()
    assert len(after) > len(rows)
    assert len(read_scan(tmp_path / "out/a.pcd.bin")) == len(after) - 1


# Input that is none.


@pytest.mark.parametrize("verb", ["complete", "raydrop"])
@pytest.mark.parametrize(
    ("what", "told"),
    [
        ("empty", "an empty file"),
        ("nan", "with NaN or infinite coordinates"),
        ("rolled", "in the axes of a camera"),
        ("other", "16 rings in"),
    ],
)
def test_input_that_cannot_be_used_is_told_in_one_line(verb, what, told, tmp_path, capsys):
    xyz = unproject(street(DENSE.fine())).points_xyz_m.numpy()
    if what == "empty":
        xyz = xyz[:0]
    if what == "nan":
        xyz[3] = np.nan
    if what == "rolled":
        xyz = np.ascontiguousarray(xyz[np.random.default_rng(0).permutation(len(xyz))][:, [0, 2, 1]])  # a camera's axes
    rows = np.concatenate((xyz, np.zeros((len(xyz), 1), np.float32)), 1)
    (tmp_path / "in").mkdir()
    rows.astype("<f4").tofile(tmp_path / "in/a.bin")
    if what == "other":
        (tmp_path / "in/a.bin").unlink()
        put_pcd(tmp_path / "in/a.pcd")
    assert main([verb, f"{tmp_path}/in", f"{tmp_path}/out"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert told in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("change", ["turned", "mirrored"])
def test_a_turned_or_mirrored_cloud_comes_back_whole(change):
    scan = unproject(street(DENSE.fine()))
    x, y, z = scan.points_xyz_m.T
    points = torch.stack((-y, x, z) if change == "turned" else (x, -y, z), 1)
    done = complete_scan(Scan(points, scan.reflectance), open_model("nearest", sensor=DENSE.fine()))
    assert torch.equal(done.whole().points_xyz_m[: len(points)], points)


@pytest.mark.parametrize("ending", ["bin", "ply", "npy"])
@pytest.mark.parametrize("added", [0, 3])
def test_points_that_were_added_before_stay_marked(ending, added, tmp_path):
    points = torch.from_numpy(np.random.default_rng(0).uniform(1, 9, (20, 3)).astype(np.float32))
    earlier = torch.arange(20) >= 15
    path, (form, *_) = tmp_path / f"a.{ending}", formats.candidates(tmp_path / f"a.{ending}")
    form.write(path, Scan(points, torch.zeros(20), filled=earlier))
    kept = torch.arange(20) % 4 > 0  # the others were dropped
    done = CompletedScan(form.read(path), kept, Scan(points[:added], torch.zeros(added)) if added else None)
    write_cloud(tmp_path / f"b.{ending}", "", done, form)
    again = form.read(tmp_path / f"b.{ending}")
    assert again.filled is not None
    assert again.filled.tolist() == [*earlier[kept].tolist(), *[True] * added]


@pytest.mark.parametrize("is_own", [True, False])
def test_intensity_of_a_completed_las_is_what_it_was(tmp_path, is_own):
    laspy = pytest.importorskip("laspy")
    scan, las = unproject(street(SIXTEEN)), formats.load("las")
    las.write(tmp_path / "own.las", scan)
    (cloud := laspy.read(tmp_path / "own.las")).header.generating_software = "another program"
    cloud.remove_extra_dim("reflectance")
    cloud.write(str(tmp_path / "other.las"))
    read = read_scan(path := tmp_path / ("own.las" if is_own else "other.las"))
    written = CompletedScan(read, torch.arange(len(read)) > 9, read.select(torch.arange(10)))
    write_cloud(tmp_path / "out.las", "", written, las)
    before, after = (laspy.read(each) for each in (path, tmp_path / "out.las"))
    assert np.array_equal(before.intensity, np.roll(after.intensity, 10))
    again = read_scan(tmp_path / "out.las")
    assert torch.equal(again.reflectance.roll(10), read.reflectance)
    assert again.full_scale == read.full_scale


@pytest.mark.parametrize(("kind", "angle"), [(3, "scan_angle_rank"), (5, "user_data"), (7, "scan_angle")])
def test_a_completed_las_keeps_class_colour_and_dimensions_of_its_own(kind, angle, tmp_path):
    laspy = pytest.importorskip("laspy")
    scan = unproject(street(SIXTEEN))
    cloud = laspy.LasData(laspy.LasHeader(version="1.4", point_format=kind))
    cloud.header.scales = np.full(3, 0.001)
    cloud.header.add_extra_dims([laspy.ExtraBytesParams("echo width", np.float32)])
    cloud = laspy.LasData(cloud.header)
    cloud.xyz, number = scan.points_xyz_m.double().numpy(), np.arange(len(scan))
    for name in ("classification", "red", "blue", "return_number", "point_source_id", "echo width", angle):
        cloud[name] = number % (256 if kind == 7 and name == "classification" else 7)
    cloud.gps_time = number * 1e-6
    cloud.write(str(tmp_path / "in.las"))
    done = CompletedScan(read := read_scan(tmp_path / "in.las"), torch.arange(len(read)) > 9)
    write_cloud(tmp_path / "a.las", "", replace(done, filled=read.select(torch.arange(10))), formats.load("las"))
    after = laspy.read(tmp_path / "a.las")
    assert len(after) == len(scan)
    for name in {*cloud.point_format.dimension_names} - {"X", "Y", "Z"}:
        if "wave" not in name and not name.endswith("_t"):
            assert np.array_equal(cloud[name][10:], after[name][:-10]), name
    assert set(after["echo width"][-10:]) <= set(range(7)), "of the nearest measured point"
    write_cloud(tmp_path / "a.ply", ".ply", done, None)
    assert np.array_equal(columns_of_file(read_scan(tmp_path / "a.ply"))["red"], cloud.red[10:])


@pytest.mark.parametrize("ending", [".pcd", ".ply", ".las", ".npz"])
def test_columns_of_rare_types_and_names_are_written(ending, tmp_path):
    (form,) = formats.candidates(path := tmp_path / f"a{ending}")
    scan = unproject(street(SIXTEEN))
    columns = {axis: scan.points_xyz_m[:, at].numpy() for at, axis in enumerate("xyz")}
    columns |= {"ring": scan.ring.numpy().astype(np.float16), "is_wet": scan.ring.numpy() > 7}
    columns |= {name: np.arange(len(scan), dtype=np.longdouble) / 3 for name in ("file", "points")}
    form.write_columns(path, columns)
    again = read_scan(path)
    assert torch.equal(again.ring, scan.ring)
    if ending != ".npz":
        assert np.array_equal(columns_of_file(again)["is_wet"], columns["is_wet"])
        assert np.array_equal(columns_of_file(again)["file"], columns["file"].astype(np.float64))
    if ending == ".npz":
        with np.load(path) as archive:
            assert np.array_equal(archive["points_"], columns["points"])


@pytest.mark.parametrize("ending", [".pcd", ".ply"])
def test_columns_whose_names_differ_in_blanks_or_lack_are_all_written(ending, tmp_path):
    (form,) = formats.candidates(path := tmp_path / f"a{ending}")
    columns = {name: np.arange(5.0) + number for number, name in enumerate(("x", "y", "z", "a b", "a_b", "a,b", ""))}
    form.write_columns(path, columns)
    again = columns_of_file(read_scan(path, bad_points="drop"))
    assert {name: int(values[0]) for name, values in again.items() if name not in "xyz"} == {
        "a_b_": 3,
        "a_b": 4,
        "a_b__": 5,
        "_": 6,
    }


def test_clouds_of_other_columns_than_the_sensor_beside_them_are_told_once(tmp_path, capsys):
    (tmp_path / "in").mkdir()
    for name, columns in {"a": 64, "b": 128, "c": 256}.items():
        formats.load("ply").write(tmp_path / f"in/{name}.ply", unproject(street(DENSE.fine().with_columns(columns))))
    (tmp_path / "own.json").write_text(json.dumps(DENSE.fine().with_columns(64).to_json()))
    words = ["--model", "nearest", "--sensor", f"{tmp_path}/own.json"]
    assert main(["complete", f"{tmp_path}/in", f"{tmp_path}/out", *words]) == 0
    assert capsys.readouterr().err.count("columns and sensor.json") == 1
    assert load_sensor(tmp_path / "out/sensor.json").width == 64
