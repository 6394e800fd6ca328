"""The time of each point: read in the units of drivers, kept through selections, and written again."""

import numpy as np
import pytest
import torch

import lidargrit
from format_examples import written
from lidargrit.data import formats
from lidargrit.data.export import export_scans
from lidargrit.scans.types import Scan

XYZ = np.random.default_rng(0).uniform(1, 20, (500, 3)).astype(np.float32)
SINCE_S = np.linspace(0, 0.1, 500)  # as a revolution at 10 Hz


@pytest.mark.parametrize(
    ("name", "column"),
    [
        ("time", SINCE_S.astype(np.float32)),  # Velodyne
        ("t", (SINCE_S * 1e9).round().astype(np.uint32)),  # Ouster
        ("offset_time", (SINCE_S * 1e9).round().astype(np.uint32)),  # Livox
        ("timestamp", 1.7e9 + SINCE_S),  # Hesai, RoboSense
        ("gps_time", 2e5 + SINCE_S),  # LAS
        ("time", SINCE_S * 1e3),  # milliseconds, told by how long a revolution lasts
        ("timestamps", (1.7e15 + SINCE_S * 1e6).round().astype(np.int64)),  # microseconds since 1970
        ("timestamp", (1_700_000_000_000_000_000 + (SINCE_S * 1e9).round()).astype(np.uint64)),
    ],
)
def test_times_are_seconds_whatever_a_driver_calls_them(name, column):
    scan = _scan(**{name: column})
    assert scan.point_time_s is not None
    np.testing.assert_allclose(scan.point_time_s - scan.point_time_s[0], SINCE_S, atol=2e-6)


@pytest.mark.parametrize("kind", [np.int8, np.uint8, np.int16, np.uint16, np.uint64])
def test_numbers_of_few_bits_are_times_too(kind):
    milliseconds = (SINCE_S * 1e3).round().astype(kind)
    since_s = _scan(time=milliseconds).point_time_s
    assert since_s is not None
    np.testing.assert_allclose(since_s, milliseconds / 1e3)


def test_another_unit_than_the_usual_is_told():
    assert any("milliseconds" in note for note in _scan(time=SINCE_S * 1e3).notes)
    assert not any("time" in note for note in _scan(time=SINCE_S).notes)


@pytest.mark.parametrize("column", [np.zeros(500), np.full(500, 1.7e9), np.full(500, np.nan)])
def test_a_column_that_tells_no_times_is_none(column):
    assert _scan(time=column).point_time_s is None


def test_times_stay_with_their_points():
    whole = Scan.from_points(XYZ, time=SINCE_S)
    which = torch.arange(500) % 3 == 0
    some = whole.select(which)
    assert some.point_time_s is not None
    np.testing.assert_array_equal(some.point_time_s, SINCE_S[which.numpy()])
    assert torch.equal(some.points_xyz_m, whole.points_xyz_m[which])


def test_points_that_are_dropped_take_their_times_with_them():
    xyz = XYZ.copy()
    xyz[7] = np.nan
    kept = Scan.from_points(xyz, time=SINCE_S, bad_points="drop")
    assert kept.point_time_s is not None
    np.testing.assert_array_equal(kept.point_time_s, np.delete(SINCE_S, 7))


def test_added_points_get_the_time_of_the_nearest_ray_that_was_measured():
    scan = lidargrit.simulate(seed=0)
    turn_s = torch.atan2(scan.points_xyz_m[:, 1], scan.points_xyz_m[:, 0]).double()
    sensor = lidargrit.load_sensor("hdl64e_kitti_odometry").with_columns(512, 2)
    nearest = lidargrit.open_model("nearest", sensor=sensor)
    timed = Scan.from_points(scan.points_xyz_m, time=turn_s)
    whole = lidargrit.complete(timed, nearest).whole()
    assert whole.point_time_s is not None
    assert whole.filled is not None
    assert torch.equal(whole.point_time_s[: len(scan)], turn_s)
    x, y, _ = whole.points_xyz_m[whole.filled].double().T
    apart = (torch.atan2(y, x) - whole.point_time_s[whole.filled]).abs()
    assert float((apart.remainder(2 * np.pi) < 0.2).double().mean()) > 0.9


@pytest.mark.parametrize("ending", ["pcd", "ply", "npz", "csv", "las"])
@pytest.mark.parametrize("start_s", [0.0, 1.7e9])
def test_files_keep_the_times(ending, start_s, tmp_path):
    np.savez(tmp_path / "a.npz", points=XYZ, timestamp=start_s + SINCE_S)
    export_scans(str(tmp_path / "a.npz"), tmp_path / "out", ending)
    (file,) = (tmp_path / "out").glob(f"*.{ending}")
    again = formats.read_scan(file)
    assert again.point_time_s is not None
    np.testing.assert_allclose(again.point_time_s, start_s + SINCE_S, rtol=0, atol=5e-7)


@pytest.mark.parametrize("index", [0, 1])
def test_argoverse_tells_the_times_of_each_of_its_sensors(index, tmp_path):
    feather = pytest.importorskip("pyarrow.feather")
    path = written(formats.load("argoverse_feather"), tmp_path)
    table = feather.read_table(path)
    offset_ns = np.linspace(0, 1e8, len(table)).round().astype(np.int32)
    laser = np.where(np.arange(len(table)) % 3 == 0, 32, 0) + table["laser_number"].to_numpy()
    table = table.set_column(table.schema.get_field_index("offset_ns"), "offset_ns", [offset_ns])
    table = table.set_column(table.schema.get_field_index("laser_number"), "laser_number", [laser.astype(np.uint8)])
    feather.write_feather(table, str(path))
    scan = formats.load("argoverse_feather").read(path, index)
    assert scan.point_time_s is not None
    np.testing.assert_allclose(scan.point_time_s, offset_ns[laser // 32 == index] / 1e9, atol=1e-12)


def _scan(**column):
    return Scan.from_points(XYZ) if not column else _of_columns({**dict(zip("xyz", XYZ.T, strict=True)), **column})


def _of_columns(columns):
    from lidargrit.scans.columns import parts_of_columns

    return Scan(**parts_of_columns(columns, "a test", "refuse"))
