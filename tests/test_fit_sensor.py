"""Fitting a sensor finds what made the scans: every sensor of ours from simulated scans, real ones from their sets."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidargrit import project, simulate
from lidargrit.cli import main
from lidargrit.core.errors import ConfigError, ScanError
from lidargrit.data.datasets import open_dataset
from lidargrit.data.prepared.config import DataConfig
from lidargrit.scans.fit_sensor import SensorFit, farthest_m, fit_sensor, fit_sensor_to_dataset, quantum_m
from lidargrit.scans.fit_sensor.azimuths import columns_of_scans
from lidargrit.scans.fit_sensor.elevations import nearest_row, rows_of_rings
from lidargrit.scans.fit_sensor.table import as_table
from lidargrit.scans.sensors import SensorModel, column_azimuths_rad, load_sensor
from lidargrit.scans.types import Scan

SMALL = {  # fewer columns than the real ones, for time; the rows are what is hard
    "hdl64e_kitti_odometry": 512,
    "hdl32e": 542,
    "vlp16": 600,
    "vlp32c": 600,
    "os1_64": 512,
    "os1_128": 304,
    "pandar64": 400,
}


def rows_deg(sensor: SensorModel) -> np.ndarray:
    return sensor.elevation_rad[:, 0].rad2deg().double().numpy()


def shuffled(scan: Scan, seed: int) -> Scan:
    order = torch.randperm(len(scan), generator=torch.Generator().manual_seed(seed))
    return Scan(scan.points_xyz_m[order].contiguous(), source="shuffled")


def room(sensor: SensorModel, seed: int, clockwise: bool = True, far_m: float = 40.0) -> Scan:
    """Return a complete scan of a room, column by column as drivers write them, lasers in an order of their own."""
    rng = np.random.default_rng(seed)
    firing = np.random.default_rng(0).permutation(sensor.height)
    elevation = sensor.elevation_rad[:, 0].double().numpy()[firing]
    aside = np.zeros(sensor.height) if sensor.azimuth_offset_rad is None else sensor.azimuth_offset_rad.double().numpy()
    turn = sensor.azimuth_rad[0].double().numpy()
    azimuth = (turn if clockwise else turn[::-1])[:, None] + aside[firing]
    range_m = 8 + (far_m - 8) * rng.random(azimuth.shape)
    flat = range_m * np.cos(elevation)
    points = np.stack((flat * np.cos(azimuth), flat * np.sin(azimuth), range_m * np.sin(elevation)), axis=-1)
    return Scan(torch.from_numpy(points.reshape(-1, 3).astype(np.float32)), source="a room")


@pytest.fixture(scope="module", params=SMALL)
def simulated(request) -> tuple[SensorModel, list[Scan]]:
    sensor = load_sensor(request.param).with_columns(SMALL[request.param])
    return sensor, [simulate(seed, sensor) for seed in range(2)]


def near(fit: SensorFit, sensor: SensorModel, within_deg: float) -> None:
    assert fit.sensor.height == sensor.height
    assert np.abs(rows_deg(fit.sensor) - rows_deg(sensor)).max() < within_deg


def test_finds_each_of_our_sensors_in_simulated_scans(simulated):
    sensor, scans = simulated
    with_field = fit_sensor(scans, "again")
    near(with_field, sensor, 0.05)
    assert with_field.method == "ring field"
    assert with_field.sensor.name == "again"
    assert with_field.sensor.projection == "unfolding"
    assert abs(with_field.sensor.width / sensor.width - 1) < 0.01
    assert with_field.sensor.width % 8 == 0, "networks halve the columns"
    assert with_field.sensor.range_min_m == 1.0
    assert with_field.sensor.range_max_m <= math.ceil(sensor.range_max_m)
    again = SensorModel.from_json(with_field.sensor.to_json())
    assert again.same_rays(with_field.sensor)


def test_finds_each_of_our_sensors_where_the_field_numbers_the_points(simulated):
    sensor, scans = simulated
    fit = fit_sensor([Scan(scan.points_xyz_m, ring=torch.arange(len(scan))) for scan in scans])
    near(fit, sensor, 0.05)
    if fit.method == "ring by ring":
        assert fit.counter_clockwise
        assert fit.start_deg == 0
        assert fit.sensor.projection == "unfolding"


def test_finds_each_of_our_sensors_in_shuffled_points(simulated):
    sensor, scans = simulated
    fit = fit_sensor([shuffled(scan, seed) for seed, scan in enumerate(scans)])
    near(fit, sensor, 0.05)
    assert fit.method == "elevation clusters"
    assert fit.sensor.projection == "spherical"
    assert fit.counter_clockwise is None
    assert abs(fit.sensor.width / sensor.width - 1) < 0.01
    assert any("gather" in warning for warning in fit.warnings)


@pytest.mark.parametrize("name", ["vlp32c", "os1_128", "pandar64", "vlp16"])
@pytest.mark.parametrize("clockwise", [True, False])
def test_finds_rings_turning_and_offsets_in_files_written_column_by_column(name, clockwise):
    sensor = load_sensor(name).with_columns(360)
    fit = fit_sensor([room(sensor, seed, clockwise) for seed in range(2)])
    near(fit, sensor, 1e-3)
    assert fit.method == "column by column"
    assert fit.sensor.width == 360
    assert fit.counter_clockwise is not clockwise
    found, made = fit.sensor.azimuth_offset_rad, sensor.azimuth_offset_rad
    if made is None:
        assert found is None
    else:
        assert found is not None
        aside = (found - made).rad2deg()
        assert float(aside.max() - aside.min()) < 0.01  # what is common to all lasers cannot be told from the column


def test_a_laser_that_never_returns_leaves_the_offsets_of_the_others():
    """Files keep its entries, so a firing has as many as before."""
    sensor = load_sensor("os1_128").with_columns(360)
    scans = []
    for seed in range(2):
        points_xyz_m = room(sensor, seed).points_xyz_m.view(360, sensor.height, 3)
        points_xyz_m[:, 5] *= 0.5 / points_xyz_m[:, 5].norm(dim=-1, keepdim=True)  # a placeholder
        scans.append(Scan(points_xyz_m.view(-1, 3), source="a room"))
    dead = int(np.random.default_rng(0).permutation(sensor.height)[5])
    made = np.delete(sensor.azimuth_offset_rad.double().numpy(), dead)
    found = fit_sensor(scans).sensor.azimuth_offset_rad
    assert found is not None
    aside = np.degrees(found.double().numpy() - made)
    assert aside.max() - aside.min() < 0.01


def test_finds_the_heights_of_lasers_above_the_origin():
    """KITTI's lasers sit up to 21 cm above the origin of its scans; a slow loop of lines tells the same."""
    rng = np.random.default_rng(0)
    laser_deg, height_m = np.array([2.0, 1.5, -3.0, -8.0]), np.array([0.21, 0.21, 0.2, 0.12])
    ring = np.repeat(np.arange(4), 500)
    range_m = rng.uniform(4, 60, 2000)
    elevation = laser_deg[ring] + np.degrees(height_m[ring] / range_m) + rng.normal(0, 0.003, 2000)
    elevation[::50] += 3  # outliers
    rows = rows_of_rings(elevation, range_m, ring)
    assert rows.laser_elevation_deg == pytest.approx(laser_deg, abs=0.003)
    assert rows.laser_height_m == pytest.approx(height_m, abs=0.002)
    for number in range(4):
        clean = (ring == number) & (np.arange(2000) % 50 > 0)
        line = np.polyfit(1 / range_m[clean], elevation[clean], 1)
        assert rows.laser_elevation_deg[number] == pytest.approx(line[1], abs=0.002)
        assert rows.elevation_deg[number] == pytest.approx(np.median(elevation[ring == number]), abs=0.02)
    assert rows.residual_deg.max() < 0.006


def test_the_nearest_row_is_that_of_a_slow_search():
    rows = np.sort(np.random.default_rng(1).uniform(-25, 15, 40))[::-1]
    points = np.random.default_rng(2).uniform(-30, 20, 500)
    assert nearest_row(points, rows).tolist() == [int(np.abs(rows - point).argmin()) for point in points]


@pytest.mark.parametrize("step_m", [0.012, 0.004, 0.002])
def test_finds_the_step_of_ranges_and_no_step_where_there_is_none(step_m):
    values = np.random.default_rng(0).uniform(1, 60, 5000)
    assert quantum_m(np.round(values / step_m) * step_m) == step_m
    assert quantum_m(values) is None


def test_the_far_limit_holds_all_but_strays():
    values = np.random.default_rng(0).uniform(2.34, 71.2, 100_000)
    assert farthest_m(values) == 72.0
    assert farthest_m(np.append(values, [0.01, 900.0])) == 72.0


def test_scans_with_another_number_of_rings_are_left_out_and_said():
    sensor = load_sensor("vlp16").with_columns(128)
    scans = [Scan(simulate(seed, sensor).points_xyz_m) for seed in range(5)]
    ring = simulate(4, sensor).ring
    assert ring is not None
    scans[4] = Scan(scans[4].points_xyz_m[ring != 7])
    fit = fit_sensor(scans)
    near(fit, sensor, 0.05)
    assert fit.method == "ring by ring"
    assert fit.num_scans == 4
    assert any("another number of rings" in warning for warning in fit.warnings)


def hopeless(what: str) -> Scan:
    rng = np.random.default_rng(0)
    azimuth = np.sort(rng.uniform(-math.pi, math.pi, 20_000))
    circle = np.stack((10 * np.cos(azimuth), 10 * np.sin(azimuth)), axis=1)
    points = {
        "one ring": np.column_stack((circle, np.full(20_000, -0.5))),
        "a map": rng.uniform((-40, -40, -3), (40, 40, 6), (20_000, 3)),
        "a crop": np.column_stack((10 + rng.random(2000), rng.uniform(-9, 9, 2000), rng.uniform(-1, 1, 2000))),
        "few points": rng.normal(0, 10, (50, 3)),
        "on the axis": np.array([[0.0, 0.0, 5.0 + i] for i in range(300)]),
        "all near": rng.normal(0, 0.1, (5000, 3)),
        "one point often": np.tile([[10.0, 1.0, 1.0]], (5000, 1)),
    }[what]
    return Scan(torch.from_numpy(points.astype(np.float32)), source=what)


@pytest.mark.parametrize(
    "what", ["one ring", "a map", "a crop", "few points", "on the axis", "all near", "one point often"]
)
def test_refuses_scans_that_show_no_sensor_in_one_line(what):
    with pytest.raises(ScanError) as caught:
        fit_sensor([hopeless(what)])
    assert "\n" not in str(caught.value)
    assert what in str(caught.value)


def test_refuses_rings_seen_from_another_place_or_at_one_elevation():
    scan = simulate(0, load_sensor("vlp16").with_columns(300))
    moved = scan.points_xyz_m + torch.tensor([1.3, 0.0, 2.5])
    with pytest.raises(ScanError, match="own frame"):
        fit_sensor([Scan(moved, ring=scan.ring)])
    assert scan.ring is not None
    with pytest.raises(ScanError, match="and 40, both at"):
        fit_sensor([Scan(scan.points_xyz_m, ring=scan.ring.where(torch.arange(len(scan)) != 5, 40))])


def test_refuses_no_scans_and_no_name():
    with pytest.raises(ConfigError, match="no scan"):
        fit_sensor([])
    for name, count, message in ((" ", 1, "--name ' '; wanted a name"), ("a", -1, "-n -1; wanted .* or 0 for all")):
        with pytest.raises(ConfigError, match=message):
            fit_sensor_to_dataset(open_dataset("simulated:1"), name, count)


def test_no_number_of_scans_takes_all(folder):
    assert fit_sensor_to_dataset(open_dataset(str(folder)), num_scans=0).num_scans == 2
    assert fit_sensor_to_dataset(open_dataset(str(folder)), num_scans=1).num_scans == 1


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("scans")
    sensor = load_sensor("hdl64e_kitti_odometry").with_columns(256)
    for seed in range(2):
        scan = simulate(seed, sensor)
        rows = torch.cat((scan.points_xyz_m, torch.zeros(len(scan), 1)), dim=1)
        (root / f"{seed}.bin").write_bytes(rows.numpy().astype("<f4").tobytes())
    return root


def test_the_verb_writes_a_sensor_and_a_picture_that_others_accept(folder, tmp_path, capsys):
    out, picture = tmp_path / "mine.json", tmp_path / "fit.png"
    command = ["fit-sensor", str(folder), "-o", str(out), "--picture", str(picture), "-n", "5"]
    assert main(command) == 0
    output = capsys.readouterr().out
    assert "rings       64" in output
    assert "note: only 2 scans" in output
    sensor = load_sensor(str(out))
    assert (sensor.height, sensor.name) == (64, "mine")
    assert picture.read_bytes().startswith(b"\x89PNG")
    before = out.read_bytes(), picture.read_bytes()
    assert main(command) == 2  # nothing is overwritten unasked
    assert "--overwrite" in capsys.readouterr().err
    assert (out.read_bytes(), picture.read_bytes()) == before
    assert main([*command, "--overwrite", "--name", "other"]) == 0
    assert load_sensor(str(out)).name == "other"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fit.png", "mine.json"]


@pytest.mark.parametrize(
    "arguments",
    [["-o", "mine.txt"], ["-n", "-1"], ["--name", " "], ["--name", "vlp16"], ["-o", "os1_64.json"]],
    ids=str,
)
def test_the_verb_refuses_wrong_words_in_one_line(folder, tmp_path, monkeypatch, capsys, arguments):
    monkeypatch.chdir(tmp_path)
    assert main(["fit-sensor", str(folder), *arguments]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_table_says_what_was_found():
    fit = fit_sensor([room(load_sensor("vlp32c").with_columns(360), 0)])
    text = as_table(fit)
    assert "32 (column by column; scans: 1)" in text
    assert "360 (1.000 degrees)" in text
    assert "clockwise" in text
    assert "aside of their column" in text


def scans_of(source: str, count: int = 6) -> list[Scan]:
    dataset = open_dataset(source)
    return [dataset.scan(index * len(dataset) // count) for index in range(min(count, len(dataset)))]


def off_deg(found: np.ndarray, table: np.ndarray) -> tuple[float, float]:
    off = np.abs(found - table)
    return float(np.median(off)), float(off.max())


def test_kitti_odometry_and_raw_give_the_table_of_the_hdl64e(real):
    """Rows move with the scene, for lasers sit 11 to 21 cm above the origin: the lasers themselves do not."""
    table = rows_deg(load_sensor("hdl64e_kitti_odometry"))
    fits = [
        fit_sensor(scans_of(f"{name}:{real}/{name}", 12)) for name in ("kitti_odometry", "kitti_raw", "kitti_object")
    ]
    for fit in fits:
        assert fit.sensor.height == 64
        assert fit.method == "ring by ring"
        assert fit.sensor.projection == "unfolding"
        median, worst = off_deg(rows_deg(fit.sensor), table)
        assert median < 0.05
        assert worst < 0.25
    raw, detection = fits[1:]
    assert np.abs(raw.laser_elevation_deg - detection.laser_elevation_deg).max() < 0.005
    assert raw.residual_deg.max() < 0.01
    assert 0.10 < raw.laser_height_m.min() < raw.laser_height_m.max() < 0.22
    assert raw.laser_elevation_deg[[0, 63]] == pytest.approx([1.937, -25.0], abs=0.005)


def test_nuscenes_gives_the_table_of_the_hdl32e(real):
    """Two scans of moving cars, whose tilt shows: the middle of the rows is near, single ones are not."""
    files = sorted((real / "other_sensors" / "nuscenes_hdl32e").iterdir())
    columns = [np.fromfile(path, "<f4").reshape(-1, 5) for path in files]
    scans = [Scan(torch.from_numpy(rows[:, :3].copy())) for rows in columns]
    fit = fit_sensor(scans)
    assert fit.method == "column by column"
    median, worst = off_deg(rows_deg(fit.sensor), rows_deg(load_sensor("hdl32e")))
    assert median < 0.05
    assert worst < 0.25
    assert abs(fit.sensor.width - 1084) < 10


def test_a_vlp16_like_file_gives_the_table_of_the_vlp16(real):
    text = (real / "other_sensors" / "vlp16_like" / "000000.pcd").read_text(encoding="ascii")
    points = np.array([line.split() for line in text.partition("DATA ascii\n")[2].splitlines()], dtype=np.float32)
    fit = fit_sensor([Scan(torch.from_numpy(points))])
    assert off_deg(rows_deg(fit.sensor), rows_deg(load_sensor("vlp16")))[1] < 0.01
    assert fit.coordinate_step_m == 0.01
    assert abs(fit.sensor.width - 1808) < 5


def test_an_ouster_recording_gives_its_own_table(real):
    pytest.importorskip("ouster.sdk")
    folder = real / "other_sensors" / "ouster"
    about = json.loads(next(folder.glob("*.json")).read_text(encoding="utf-8"))
    fit = fit_sensor(scans_of(str(folder), 1))
    table = np.array(about["beam_altitude_angles"])
    assert off_deg(fit.laser_elevation_deg, table)[1] < 0.005
    median, worst = off_deg(rows_deg(fit.sensor), table)
    assert median < 0.05
    assert worst < 0.1
    assert fit.sensor.width == 1024
    assert fit.range_step_m == 0.008


def test_columns_wider_than_any_sensor_has_are_not_guessed():
    assert columns_of_scans([], [], np.full(200, 6.0)) is None
    assert columns_of_scans([], [], np.full(200, 2.0)) == 180


def test_names_and_files_that_no_command_would_read(tmp_path, capsys):
    dataset = open_dataset("simulated:1")
    with pytest.raises(ConfigError, match="a name of 201 letters; wanted at most 200"):
        fit_sensor_to_dataset(dataset, "a" * 201)
    for name in ("", " ", "two\nlines", "\x1b[2J"):
        for fit in (lambda name: fit_sensor_to_dataset(dataset, name), lambda name: fit_sensor([], name)):
            with pytest.raises(ConfigError, match=r"--name '.*; wanted a name in one line that is not blank"):
                fit(name)
    path = tmp_path / "mine.JSON"
    assert main(["fit-sensor", "simulated:1", "-o", str(path), "--json", str(path)]) == 2
    assert "for two files" in capsys.readouterr().err
    assert main(["fit-sensor", "simulated:1", "-o", str(path)]) == 0
    assert load_sensor(str(path)).height == 64


def test_argoverse_gives_the_table_of_the_vlp32c(real):
    fit = fit_sensor(scans_of(str(real / "other_sensors" / "argoverse2_2xvlp32c"), 1))
    median, worst = off_deg(rows_deg(fit.sensor), rows_deg(load_sensor("vlp32c")))
    assert median < 0.05
    assert worst < 0.1
    assert column_azimuths_rad(fit.sensor.width).shape == fit.sensor.azimuth_rad.shape


@pytest.mark.parametrize(("name", "columns", "edge"), [("os1_64", 256, 0.5), ("hdl32e", 276, 0.0)])
def test_points_that_lie_half_a_column_off_keep_a_pixel_each_or_are_told(name, columns, edge):
    """Ouster's firings are on the borders of columns that begin at +pi; 276 columns are no multiple of eight."""
    sensor = load_sensor(name).with_columns(columns, 1)
    sensor = replace(sensor, azimuth_offset_rad=None)
    edge_rad = math.pi + edge * 2 * math.pi / columns
    sensor = replace(sensor, first_edge_rad=edge_rad, azimuth_rad=column_azimuths_rad(columns, first_edge_rad=edge_rad))
    scans = [simulate(seed, sensor) for seed in range(3)]
    fit = fit_sensor(scans)
    told = any(f"share a pixel (--set data.columns={columns} keeps them apart)" in note for note in fit.warnings)
    hidden, with_own_columns = (
        1 - int(project(scans[0], seen).return_mask.sum()) / len(scans[0])
        for seen in (fit.sensor, DataConfig(columns=columns).with_projection(fit.sensor))
    )
    assert (hidden <= 0.01) != told
    assert with_own_columns <= 0.01
    assert told == (columns % 8 != 0)
