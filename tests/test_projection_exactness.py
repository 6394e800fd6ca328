"""The fast projection against plain double precision: no point falls elsewhere, and the same points win."""

import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lidargrit.core import discovery
from lidargrit.core.errors import ScanError
from lidargrit.scans.projection import index_map, project
from lidargrit.scans.projection.pixel_coordinates import pixel_coordinates
from lidargrit.scans.sensors import SensorModel, column_azimuths_rad, load_sensor
from lidargrit.scans.types import Scan
from lidargrit.simulator import simulate

_FILE = Path(__file__).resolve().parents[1] / "benchmarks" / "projection.py"
_spec = importlib.util.spec_from_file_location("benchmark_projection", _FILE)
assert _spec is not None
assert _spec.loader is not None
plain = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(plain)


def sensor_of(elevation_deg, width):
    elevation_rad = torch.tensor(elevation_deg, dtype=torch.float64).deg2rad().float()[:, None]
    return SensorModel("of a test", elevation_rad, column_azimuths_rad(width), 0.9, 120.0, "spherical")


SENSORS = {name: load_sensor(name) for name in discovery.names("sensors")} | {
    "to the zenith": sensor_of([89.9, 60.0, 30.0, 0.0, -89.9], 360),
    "dense": sensor_of(np.linspace(0.3, -0.3, 256).tolist(), 65536),
    "one row": sensor_of([3.0], 1),
    "three columns": sensor_of([10.0, -10.0], 3),
}


def edges_of(sensor):
    if sensor.height > 1:
        return plain.row_edges(sensor)
    return float(sensor.elevation_rad) + np.radians([0.5, -0.5])  # a lone row is a degree high


def rows_and_columns(xyz_m, sensor):
    """Return the definition: all in double precision."""
    x, y, z = xyz_m.astype(np.float64).T
    width = sensor.width * sensor.column_stride
    row = np.searchsorted(-edges_of(sensor), -np.arctan2(z, np.hypot(x, y)), side="right") - 1
    return row, np.floor((sensor.first_edge_rad - np.arctan2(y, x)) * (width / (2 * np.pi))).astype(np.int64) % width


def on_edges(sensor, rng, count):
    """Return points on edges of columns and of rows, and a few units in the last place beside them."""
    width = sensor.width * sensor.column_stride
    azimuth = sensor.first_edge_rad - 2 * np.pi * rng.integers(0, width + 1, count) / width
    elevation = np.where(rng.random(count) < 0.7, rng.choice(edges_of(sensor), count), rng.uniform(-1.5, 1.5, count))
    azimuth = np.where(rng.random(count) < 0.7, azimuth, rng.uniform(-4, 4, count))
    far = 10 ** rng.uniform(-1, 3, count)
    level = far * np.cos(elevation)
    xyz = np.stack((level * np.cos(azimuth), level * np.sin(azimuth), far * np.sin(elevation)), 1).astype(np.float32)
    return (xyz.view(np.int32) + rng.integers(-2, 3, xyz.shape, dtype=np.int32)).view(np.float32)


def extremes():
    """Return every point of coordinates that are 0, tiny, ordinary or huge, of both signs."""
    sizes = [0.0, 1e-45, 1e-40, 1e-30, 1e-20, 1e-16, 1e-3, 1.0, 5.0, 1e10, 1e19, 1e30, 3e38]
    values = np.array([sign * size for size in sizes for sign in (1, -1)], dtype=np.float32)
    points = np.stack(np.meshgrid(values, values, values), -1).reshape(-1, 3)
    return points[(points != 0).any(axis=1)]


@given(seed=st.integers(0, 2**32 - 1), name=st.sampled_from(sorted(SENSORS)))
@settings(max_examples=100, deadline=None)
def test_no_point_falls_elsewhere_than_in_double_precision(seed, name):
    sensor, rng = SENSORS[name], np.random.default_rng(seed)
    random = rng.normal(size=(3000, 3)).astype(np.float32) * np.float32(10 ** rng.uniform(-3, 3))
    xyz_m = np.concatenate((random, on_edges(sensor, rng, 3000)))
    xyz_m = xyz_m[np.isfinite(xyz_m).all(axis=1) & (xyz_m != 0).any(axis=1)]
    pixels = pixel_coordinates(Scan(torch.from_numpy(xyz_m)), sensor, "spherical", "exact")
    row, column = rows_and_columns(xyz_m, sensor)
    assert np.array_equal(pixels.row, row)
    assert np.array_equal(pixels.column, column)
    wanted_m = np.linalg.norm(xyz_m, axis=1)
    for limit_m in (sensor.range_min_m, sensor.range_max_m):
        wanted_m[np.abs(wanted_m - limit_m) < 9e-7 * limit_m] = limit_m  # within what 32 bits round
    assert np.array_equal(pixels.range_m, wanted_m)


@pytest.mark.parametrize("name", sorted(SENSORS))
def test_tiny_and_huge_coordinates_fall_where_double_precision_says(name):
    xyz_m, sensor = extremes(), SENSORS[name]
    pixels = pixel_coordinates(Scan(torch.from_numpy(xyz_m)), sensor, "spherical", "exact")
    row, column = rows_and_columns(xyz_m, sensor)
    assert np.array_equal(pixels.row, row)
    assert np.array_equal(pixels.column, column)
    rings = plain_rings(xyz_m)
    assert np.array_equal(pixel_coordinates(Scan(torch.from_numpy(xyz_m)), sensor, "unfolding", "exact").row, rings)


def plain_rings(xyz_m):
    azimuth = np.arctan2(xyz_m[:, 1].astype(np.float64), xyz_m[:, 0].astype(np.float64)) % (2 * np.pi)
    starts = np.flatnonzero(np.diff(azimuth) < -np.pi) + 1
    lengths = np.diff(np.concatenate(([0], starts, [len(xyz_m)])))
    true_ring = lengths >= max(1.0, 0.01 * float(np.median(lengths)))
    return np.repeat(np.maximum(np.cumsum(true_ring) - 1, 0), lengths)


@given(seed=st.integers(0, 2**32 - 1), turns=st.integers(1, 40))
@settings(max_examples=50, deadline=None)
def test_rings_begin_where_the_azimuth_falls(seed, turns):
    rng = np.random.default_rng(seed)
    azimuth = np.linspace(0, turns * 2 * np.pi, 4000) + rng.normal(0, 10 ** rng.uniform(-6, 0), 4000)
    y = np.where(rng.random(4000) < 0.05, rng.choice([0.0, -0.0, 1e-45, -1e-45], 4000), np.sin(azimuth))
    xyz_m = np.stack((np.cos(azimuth), y, np.ones(4000)), 1).astype(np.float32)
    rows = pixel_coordinates(Scan(torch.from_numpy(xyz_m)), SENSORS["three columns"], "unfolding", "exact").row
    assert np.array_equal(rows, plain_rings(xyz_m))


@pytest.mark.parametrize(
    ("name", "method"), [("hdl64e_kitti_360", "spherical"), ("hdl64e_kitti_odometry", "unfolding")]
)
@pytest.mark.parametrize("ring", [True, False])
def test_the_same_points_win_as_by_sorting_and_as_point_by_point(name, method, ring):
    sensor = load_sensor(name).with_columns(512, 2)
    scan = simulate(seed=3, sensor=sensor.fine())
    xyz_m = scan.points_xyz_m.clone()
    xyz_m[5::7] = xyz_m[4:-1:7][: len(xyz_m[5::7])]  # points that are there twice: the later one wins
    scan = Scan(xyz_m, None, scan.ring if ring else None)
    winner = index_map(scan, sensor, method)
    assert np.array_equal(winner, plain.by_sorting(scan, sensor, method))
    assert np.array_equal(winner, plain.by_loop(scan, sensor, method))
    image, expected = project(scan, sensor, method), plain.image_of(winner, scan, sensor)
    assert torch.equal(image.range_m, expected.range_m)
    assert torch.equal(image.return_mask, expected.return_mask)


@pytest.mark.shared
def test_real_scans_give_the_same_image_as_by_sorting(real):
    paths = sorted(real.glob("kitti_*/**/*.bin"))[::12]
    assert len(paths) > 3
    for path in paths:
        scan = Scan(torch.from_numpy(np.fromfile(path, "<f4").reshape(-1, 4)[:, :3].copy()))
        for name, method in (("hdl64e_kitti_360", "spherical"), ("hdl64e_kitti_odometry", "unfolding")):
            sensor = load_sensor(name)
            assert np.array_equal(index_map(scan, sensor, method), plain.by_sorting(scan, sensor, method)), path.name


@pytest.mark.parametrize("sectors", [26, 27])
def test_a_part_of_the_circle_is_told_by_its_sectors(sectors):
    # One far point in every sector but the first, which has nearly all: a sample of the points does not see them.
    azimuth = np.concatenate((np.full(50_000, math.radians(5)), np.radians(10 * np.arange(1, sectors) + 5)))
    points = 10 * np.stack((np.cos(azimuth), np.sin(azimuth), np.full_like(azimuth, -0.1)), 1)
    scan, sensor = Scan(torch.from_numpy(points.astype(np.float32))), load_sensor("hdl64e_kitti_360")
    if sectors == 27:
        assert int(project(scan, sensor).return_mask.sum()) == 27
    else:
        with pytest.raises(ScanError, match="only 260 of 360 degrees"):
            project(scan, sensor)
