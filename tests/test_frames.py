"""Points that are not in their sensor's frame: coordinates of a map, other units, a car's frame."""

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import ScanError
from lidargrit.data.formats import read_scan
from lidargrit.scans.fit_sensor import fit_sensor
from lidargrit.scans.projection import project
from lidargrit.scans.projection.frame import told_height
from lidargrit.scans.projection.inspection import inspect
from lidargrit.scans.projection.sensor_check import closest_sensor
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import Scan
from street_corner import COLUMNS, corner, pcd_bytes, rows_of, xyz_of

UTM_M = np.array([458_000.123, 5_427_000.456, 112.5])  # a place in UTM zone 32N, made up
VLP16 = load_sensor("vlp16").with_columns(COLUMNS)
OF_A_MAP = r"coordinates of a map in .* \(5,446 km from the origin\); .*subtract the sensor's place from x, y and z"


def test_coordinates_of_a_map_are_told():
    scan = Scan((xyz_of(corner()).double() + torch.from_numpy(UTM_M)).float())
    for use in (lambda: project(scan, VLP16), lambda: fit_sensor([scan])):
        with pytest.raises(ScanError, match=OF_A_MAP):
            use()
    assert "coordinates of a map" in inspect(scan, VLP16).problems[0]


@pytest.mark.parametrize("verb", ["inspect", "export"])
def test_coordinates_that_32_bits_would_move_are_refused(tmp_path, verb, capsys):
    points = xyz_of(corner()).double().numpy() + UTM_M
    (tmp_path / "a.pcd").write_bytes(pcd_bytes(rows_of(dict(zip("xyz", points.T, strict=True)))))
    more = [str(tmp_path / "out"), "--format", "ply"] if verb == "export" else []
    assert main([verb, str(tmp_path / "a.pcd"), *more]) == 2
    told = capsys.readouterr().err
    assert "coordinates of a map in " in told
    lost_m = np.abs(points - points.astype(np.float32)).max(axis=1)
    moved = f"move by {np.median(lost_m):.3f} m in the median and {lost_m.max():.3f} m at most in the 32 bits"
    assert moved in told
    assert lost_m.max() > 0.2
    assert "subtract the sensor's place from x, y and z" in told


def test_doubles_near_the_sensor_are_read(tmp_path):
    points = xyz_of(corner()).double().numpy() + np.array([0, 0, 0.000_123])
    points[0] = 1e7  # one stray point shows no map
    (tmp_path / "a.pcd").write_bytes(pcd_bytes(rows_of(dict(zip("xyz", points.T, strict=True)))))
    assert np.allclose(read_scan(tmp_path / "a.pcd").points_xyz_m.numpy(), points, atol=1e-3)


@pytest.mark.parametrize("factor", [100, 1000])
def test_other_units_are_told(factor):
    scan = Scan(xyz_of(corner()) * factor)
    for use in (lambda: project(scan, VLP16), lambda: fit_sensor([scan])):
        with pytest.raises(ScanError, match=r"points at .* m in the median in a scan; wanted metres; check the unit"):
            use()


def test_numbers_that_are_no_coordinates_are_told():
    scan = Scan(xyz_of(corner()) * 1e36)
    for use in (lambda: project(scan, VLP16), lambda: fit_sensor([scan])):
        with pytest.raises(ScanError, match=r"points at \de\+36 m in the median in a scan; .*; check of which type"):
            use()


def test_a_sensor_is_not_fitted_to_points_beyond_all_reach():
    points = xyz_of(corner())
    points[::100] *= 1e5
    far = int((points.norm(dim=1) > 1000).sum())
    with pytest.raises(ScanError, match=rf"got {far} points beyond 1,000 m; wanted .*; leave them out"):
        fit_sensor([Scan(points)])


def test_points_in_the_sensors_frame_are_not_doubted():
    scan = Scan(xyz_of(corner()) * 10)
    assert torch.isfinite(project(scan, VLP16).range_m).all()


@pytest.mark.parametrize("height_m", [1.8, -0.64])
def test_the_height_of_a_cars_frame_is_told(height_m):
    points = xyz_of(corner()) + torch.tensor([0, 0, height_m])
    problems = inspect(Scan(points), VLP16).problems
    where, cure = ("below", "subtract 1.80 m from z") if height_m > 0 else ("above", "add 0.64 m to z")
    assert f"points of a scan are seen from {abs(height_m):.2f} m {where} the sensor (vlp16)" in problems[-1]
    assert problems[-1].endswith(cure)


@pytest.mark.parametrize("name", ["vlp16", "hdl32e", "pandar64"])
def test_the_sensor_of_points_in_a_cars_frame_is_guessed_and_its_height_told(name, tmp_path, capsys):
    points = xyz_of(corner(0, load_sensor(name), 256)) + torch.tensor([0, 0, 1.8])
    points = points[torch.randperm(len(points), generator=torch.Generator().manual_seed(0))]
    assert closest_sensor(Scan(points)) == name
    np.savez(tmp_path / "a.npz", points=points.numpy())
    told = f"a.npz are seen from 1.80 m below the sensor ({name})"
    out = str(tmp_path / "out")
    fit = ["fit-sensor", "-o", f"{out}.json"]
    for words in (["inspect"], ["prepare", "-o", out], ["complete", f"{out}_whole", "--model", "linear"], fit):
        main([words[0], str(tmp_path / "a.npz"), *words[1:]])
        output = capsys.readouterr()
        assert told in output.out + output.err, words


def test_points_whose_z_counts_from_the_ground_are_doubted():
    sensor = load_sensor("vlp16").with_columns(256)
    points = xyz_of(corner(0, sensor, 256)) * torch.tensor([1, 1, 0.9])  # of rows that no model of ours has
    raised = points + torch.tensor([0, 0, 1.8 * 0.9])
    told = told_height(Scan(raised), sensor)
    assert told.startswith("99% of a scan lie above -0.")
    assert told.endswith("looks down to -15.0; if z counts from the ground, subtract the sensor's height from it")
    assert told in inspect(Scan(raised), sensor).problems
    assert told_height(Scan(points), sensor) == ""


def test_the_axes_of_a_camera_are_told():
    x, y, z = xyz_of(corner()).unbind(1)
    scan = Scan(torch.stack([-y, -z, x], dim=1))
    for use in (lambda: project(scan, VLP16), lambda: fit_sensor([scan])):
        with pytest.raises(ScanError, match=r"and over 30 in the axes of a camera; .*save z, -x, -y as x, y, z"):
            use()


@pytest.mark.parametrize("name", ["vlp16", "vlp32c", "hdl32e", "hdl64e_kitti_odometry", "os1_64"])
def test_no_height_is_told_of_points_in_a_sensors_own_frame(name):
    sensor = load_sensor(name).with_columns(256)
    scan = Scan(xyz_of(corner(0, sensor, 256)))
    assert told_height(scan, sensor) == ""
    assert told_height(Scan(xyz_of(corner())), sensor) == ""  # of another sensor
