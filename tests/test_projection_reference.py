"""Our ``reference`` projection against the index maps of the reference programs, pixel for pixel."""

import json

import numpy as np
import pytest
import torch

from lidargrit.scans.projection import index_map, project
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import Scan

SYNTHETIC = ["projection_0", "projection_1", "projection_corner", "projection_rings20", "projection_rings70"]
REAL = ["real_kitti360_drive0000_0000000000", "real_odometry00_000095"]


def scan_of(golden, shared, name):
    if name in SYNTHETIC:
        xyz = golden(name)["xyz"]
    else:
        path = shared / json.loads(str(golden(name)["source"]))["scan"]
        xyz = np.fromfile(path, dtype=np.float32).reshape(-1, 4)[:, :3]
    return Scan(torch.from_numpy(np.ascontiguousarray(xyz)))


@pytest.mark.shared
@pytest.mark.parametrize("name", SYNTHETIC + REAL)
@pytest.mark.parametrize(
    ("method", "key"), [("spherical", "lidargrit_spherical_2048"), ("unfolding", "lidargrit_unfold_2048")]
)
def test_reference_index_map_is_the_programs(golden, shared, name, method, key):
    sensor = load_sensor("hdl64e_kitti_odometry").with_columns(2048)
    scan = scan_of(golden, shared, name)
    ours, theirs = index_map(scan, sensor, method, "reference"), golden(name)[key]
    range_m = np.linalg.norm(scan.points_xyz_m.numpy(), axis=1)
    same = (ours == theirs) | ((ours >= 0) & (theirs >= 0) & (range_m[ours] == range_m[theirs]))  # ties may swap
    # On the border of a cell the last bit of the arc functions decides, which differs from processor to processor.
    assert (~same).sum() <= 4
    x, y, _ = scan.points_xyz_m.double().numpy().T
    exact_column = 2048 * (-np.arctan2(y, x) / np.pi + 1) / 2
    to_border = np.abs(exact_column % 1 - 0.5)
    if name != "projection_corner":  # whose hand-made points sit on the borders of rows, too
        nearest = [
            to_border[[at for at in pair if at >= 0]].min() for pair in zip(ours[~same], theirs[~same], strict=True)
        ]
        assert max(nearest, default=0) < 3e-4


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "sensor_name", "columns", "stride"),
    [
        ("dataset_kitti_360", "hdl64e_kitti_360", 2048, 2),
        ("dataset_kitti", "hdl64e_kitti_odometry", 2048, 8),
    ],
)
@pytest.mark.parametrize("index", [0, 1])
def test_reference_range_image_and_network_input(golden, name, sensor_name, columns, stride, index):
    from lidargrit.scans.projection import RangeEncoding

    data = golden(name)
    sensor = load_sensor(sensor_name).with_columns(columns, stride)
    scan = Scan(torch.from_numpy(data[f"scan_{index}"][:, :3].copy()))
    image = project(scan, sensor, variant="reference")
    assert np.array_equal(image.return_mask.numpy(), data[f"mask_{index}"] > 0)
    span = sensor.range_max_m - sensor.range_min_m
    unit = torch.where(image.return_mask, (image.range_m - sensor.range_min_m) / span, 0.0)
    assert np.allclose(unit.numpy(), data[f"depth01_{index}"], atol=1e-6)
    encoding = RangeEncoding("linear", sensor.range_min_m, sensor.range_max_m)
    assert np.allclose(encoding.encode(image.range_m, image.return_mask).numpy(), data[f"net_input_{index}"], atol=1e-6)
    winners = index_map(scan, sensor, variant="reference")[:, ::stride]
    points = np.where(image.return_mask.numpy(), scan.points_xyz_m.numpy()[winners].transpose(2, 0, 1), 0)
    assert np.allclose(points / sensor.range_max_m, data[f"points_{index}"], atol=1e-6)


@pytest.mark.shared
@pytest.mark.parametrize(("key", "sensor_name"), [("kitti360", "hdl64e_kitti_360"), ("kitti", "hdl64e_kitti_odometry")])
def test_decoding_and_unprojecting_through_a_measured_angle_table(golden, key, sensor_name):
    from dataclasses import replace

    from lidargrit.scans.projection import RangeEncoding, points_of_pixels
    from lidargrit.scans.types import RangeImage

    data = golden("lidargrit_depth_xyz")
    base = load_sensor(sensor_name)
    angle = torch.from_numpy(data["angle"])
    sensor = replace(base, elevation_rad=angle[0], azimuth_rad=angle[1], column_stride=1)
    encoded = torch.from_numpy(data["depth_tanh"])[:, 0]
    encoding = RangeEncoding("linear", sensor.range_min_m, sensor.range_max_m)
    valid = (encoded.clamp(-1, 1) + 1) / 2 > 1e-8
    image = RangeImage.masked(encoding.decode(encoded), valid, sensor)
    # Where nothing returned the program leaves the shortest range, we leave 0.
    theirs_m = torch.from_numpy(data[f"{key}_metric_depth"])[:, 0]
    assert torch.allclose(image.range_m[valid], theirs_m[valid], atol=2e-5)
    xyz_unit = points_of_pixels(image).permute(0, 3, 1, 2) / sensor.range_max_m
    assert np.allclose(xyz_unit.numpy(), data[f"{key}_xyz_unit"], atol=1e-6)
