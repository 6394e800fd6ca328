"""The inspection against a slow loop over points, its figures on hand-made scans, and the verb that prints them."""

import json
import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lidargrit.cli import main
from lidargrit.core import discovery
from lidargrit.scans.projection import inspect, project, unproject
from lidargrit.scans.projection.inspection import FATES, as_json, as_table
from lidargrit.scans.projection.pixel_coordinates import pixel_coordinates
from lidargrit.scans.projection.sensor_check import closest_sensor, sensors_that_fit
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage, Scan
from lidargrit.simulator import simulate
from lidargrit.viewer.inspection import plot_inspection


def messy_scan(seed, count=3000):
    """Return points of all ranges and elevations, many of them in the same pixels, some twice."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(-np.pi, np.pi, count), np.radians(rng.uniform(-28, 5, count))
    far = 10 ** rng.uniform(-0.3, 2.2, count)
    level = far * np.cos(elevation)
    points = np.stack((level * np.cos(azimuth), level * np.sin(azimuth), far * np.sin(elevation)), 1)
    points[1::50] = points[::50]
    ring = torch.from_numpy(rng.integers(0, 64, count))
    return Scan(torch.from_numpy(points.astype(np.float32)), None, ring)


def fates_by_loop(scan, sensor, method, variant):
    pixels = pixel_coordinates(scan, sensor, method, variant)
    near, far = sensor.range_min_m, sensor.range_max_m
    fates, holder = [], {}
    points = list(zip(pixels.row.tolist(), pixels.column.tolist(), pixels.range_m.tolist(), strict=True))
    for index, (row, column, range_m) in enumerate(points):
        fate = "hidden"
        if variant == "exact" and row < 0:
            fate = "above"
        elif variant == "exact" and row >= sensor.height:
            fate = "below"
        elif variant == "exact" and not near <= range_m <= far:
            fate = "nearer" if range_m < near else "farther"
        elif column % sensor.column_stride:
            fate = "left_out"
        elif (row, column) not in holder or range_m <= points[holder[row, column]][2]:
            holder[row, column] = index
        fates.append(fate)
    for index in holder.values():
        range_m = points[index][2]
        inside = near < range_m < far or (variant == "clamped" and range_m in (near, far))
        fates[index] = "kept" if inside else ("nearer" if range_m <= near else "farther")
    return fates


@given(
    seed=st.integers(0, 10_000),
    stride=st.sampled_from([1, 4]),
    method=st.sampled_from(["spherical", "unfolding"]),
    variant=st.sampled_from(["exact", "reference", "clamped"]),
)
@settings(max_examples=30, deadline=None)
def test_every_point_has_the_fate_that_a_loop_finds(seed, stride, method, variant):
    scan, sensor = messy_scan(seed), load_sensor("hdl64e_kitti_360").with_columns(128, stride)
    found = inspect(scan, sensor, method, variant)
    fates = fates_by_loop(scan, sensor, method, variant)
    assert [list(FATES)[fate] for fate in found.fate] == fates
    assert found.counts() == {name: Counter(fates)[name] for name in FATES}
    assert sum(found.counts().values()) == len(scan)
    if not found.problems:
        image = project(scan, sensor, method, variant)
        assert np.array_equal(found.range_m, image.range_m.numpy())
        assert found.counts()["kept"] == int(image.return_mask.sum())
    wanted = found.counts()["kept"] + found.counts()["hidden"]
    assert found.points_per_pixel.sum() == wanted or variant != "exact"
    assert bool((found.points_per_pixel[found.filled()] > 0).all())


def test_a_scan_on_the_rays_is_off_by_nothing():
    sensor = load_sensor("hdl64e_kitti_360").with_columns(64)
    image = RangeImage.masked(torch.full((64, 64), 10.0), torch.ones(64, 64, dtype=torch.bool), sensor)
    found = inspect(unproject(image), sensor)
    assert found.counts()["kept"] == 64 * 64
    assert found.filled().all()
    assert max(spread.largest for spread in found.errors.values()) < 1e-4
    assert not found.problems


@pytest.mark.parametrize("method", ["spherical", "unfolding"])
def test_errors_are_those_of_points_turned_off_their_rays(method):
    sensor = load_sensor("hdl64e_kitti_360").with_columns(64)
    image = RangeImage.masked(torch.full((64, 64), 20.0), torch.ones(64, 64, dtype=torch.bool), sensor)
    scan = unproject(image)
    across, up = math.radians(1.0), math.radians(0.1)  # less than half a column, and half a row
    azimuth = torch.atan2(scan.points_xyz_m[:, 1], scan.points_xyz_m[:, 0]) + across
    elevation = torch.asin(scan.points_xyz_m[:, 2] / 20) + up
    level = 20 * elevation.cos()
    turned = torch.stack((level * azimuth.cos(), level * azimuth.sin(), 20 * elevation.sin()), 1)
    errors = inspect(Scan(turned, ring=scan.ring), sensor, method).errors
    assert errors["across_deg"].median == pytest.approx(1.0, rel=1e-3)
    assert errors["up_deg"].largest == pytest.approx(0.1, rel=1e-3)
    assert errors["up_m"].median == pytest.approx(20 * up, rel=1e-3)
    assert errors["across_m"].largest == pytest.approx(20 * across, rel=1e-2)  # at the row nearest to level
    assert errors["position_m"].median == pytest.approx(math.hypot(errors["across_m"].median, 20 * up), rel=1e-2)
    assert errors["range_m"].largest < 1e-4


def test_a_scan_that_does_not_fit_is_reported_not_refused():
    scan = simulate(seed=0, sensor=load_sensor("hdl64e_kitti_360").with_columns(128))
    scan = Scan(scan.points_xyz_m)
    wrong = inspect(scan, load_sensor("vlp16"), "unfolding")
    assert wrong.rings is not None
    assert wrong.rings > 16
    assert "rings" in wrong.problems[0]
    assert wrong.counts()["below"] > 0
    assert sum(wrong.counts().values()) == len(scan)
    assert "problem: got" in as_table(wrong)
    too_low = inspect(Scan(scan.points_xyz_m[scan.points_xyz_m[:, 2] < -1]), load_sensor("vlp16"), "spherical")
    assert any("outside the sensor's elevations" in problem for problem in too_low.problems)
    nothing = inspect(Scan(scan.points_xyz_m * 1000), load_sensor("hdl64e_kitti_360"))
    assert nothing.counts()["kept"] == 0
    assert nothing.errors == {}
    assert "no image" in nothing.problems[-1]
    json.dumps(as_json(nothing))


@pytest.mark.parametrize("name", [*discovery.names("sensors")])
def test_the_closest_sensor_is_the_one_that_made_the_scan(name):
    sensor = load_sensor(name).with_columns(360)
    every = torch.ones(sensor.height, 360)
    scan = unproject(RangeImage.masked(10 * every, every > 0, sensor))
    assert closest_sensor(scan) == sensors_that_fit(scan)[0] == name
    if name in ("hdl64e_kitti_360", "vlp16"):  # rings that are found in the order of the points
        assert closest_sensor(replace(scan, ring=None)) == name


@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_the_picture_is_drawn_even_of_nothing(tmp_path, scale):
    scan = simulate(seed=0, sensor=load_sensor("hdl64e_kitti_360").with_columns(64))
    plot_inspection(inspect(Scan(scan.points_xyz_m * scale), load_sensor("hdl64e_kitti_360")), tmp_path / "it.png")
    assert (tmp_path / "it.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


@pytest.mark.parametrize("points", ["one far beyond", "one far beyond, with rings", "all straight above"])
def test_strange_points_are_inspected_without_a_warning_of_a_library(tmp_path, points):  # which the tests refuse
    scan = simulate(seed=1, sensor=load_sensor("vlp16").with_columns(90))
    rows = np.c_[scan.points_xyz_m.numpy(), np.zeros(len(scan), np.float32)]
    if points == "all straight above":
        rows[:, :3] = [0, 0, 5]
    else:
        rows[7, :2] = 3e38
    if "rings" in points:
        assert scan.ring is not None
        rows[:, 3] = scan.ring
    np.save(tmp_path / "a.npy", rows)
    assert main(["inspect", str(tmp_path / "a.npy"), "-o", str(tmp_path / "a.png")]) == 0


def test_the_verb_prints_a_table_and_writes_what_it_is_told_to(tmp_path, capsys):
    command = ["inspect", "simulated:1", "--projection", "spherical", "--set", "data.columns=512"]
    files = ["-o", str(tmp_path / "it.png"), "--json", str(tmp_path / "it.json")]
    assert main([*command, *files]) == 0
    printed = capsys.readouterr().out
    written = json.loads((tmp_path / "it.json").read_text(encoding="utf-8"))
    assert written["image"] == [64, 512]
    points = written["points"]
    assert points["all"] == sum(points[name] for name in FATES)
    assert f"{points['kept']:>9}" in printed
    assert (tmp_path / "it.png").stat().st_size > 10_000
    assert main([*command, *files]) == 2
    assert "which is there already" in capsys.readouterr().err
    for words in ([str(tmp_path / "nothing.bin")], ["a", "--variant", "exact"]):
        assert main(["inspect", *words]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.shared
def test_real_scans_and_damaged_ones_are_accounted_for(real):
    odometry = next(iter(sorted(real.glob("kitti_odometry/**/*.bin"))))
    for path in [odometry, *sorted((real / "damaged").glob("*.bin"))]:
        xyz_m = np.fromfile(path, "<f4").reshape(-1, 4)[:, :3].copy()
        scan = Scan(torch.from_numpy(xyz_m[(xyz_m != 0).any(axis=1)]))
        for name in ("hdl64e_kitti_360", "hdl64e_kitti_odometry", "vlp16"):
            found = inspect(scan, load_sensor(name))
            assert sum(found.counts().values()) == len(scan)
            assert path != odometry or name == "vlp16" or not found.problems
