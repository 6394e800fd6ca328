"""Clouds as another sensor sees them: which points it sees, and which rays it cannot tell."""

import json
import math

import numpy as np
import pytest
import torch

import lidargrit
from lidargrit.cli import main
from lidargrit.core.errors import ConfigError, ScanError
from lidargrit.data.datasets import open_dataset
from lidargrit.data.drives import DriveConfig, write_drives
from lidargrit.data.export import export_scans
from lidargrit.data.formats.kitti_bin import KittiBin
from lidargrit.data.sources import open_source
from lidargrit.scans.rescan import Rescan
from lidargrit.scans.types import Scan

DENSE = lidargrit.load_sensor("hdl64e_kitti_odometry")
VLP16 = lidargrit.load_sensor("vlp16").with_columns(1024, 1)


@pytest.fixture(scope="module")
def scan():
    return lidargrit.simulate(seed=0)


def angles(points_xyz_m):
    x, y, z = points_xyz_m.double().numpy().T
    return np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))


def test_every_ray_has_a_measured_point_near_it_and_no_point_comes_twice(scan):
    found = Rescan(DENSE, VLP16)(scan).scan
    own = {row.tobytes() for row in scan.points_xyz_m.numpy()}
    seen = [row.tobytes() for row in found.points_xyz_m.numpy()]
    assert set(seen) <= own
    assert len(set(seen)) == len(seen)
    _, elevation = angles(found.points_xyz_m)
    assert found.ring is not None
    of_ring = VLP16.elevation_rad[found.ring, 0].double().numpy()
    widest_rad = float(-DENSE.elevation_rad[:, 0].diff().min())
    assert np.abs(elevation - of_ring).max() <= 0.76 * widest_rad
    assert found.label is not None
    at = {row.tobytes(): index for index, row in enumerate(scan.points_xyz_m.numpy())}
    assert torch.equal(found.label, scan.label[[at[one] for one in seen]])


def test_rays_without_rows_are_those_above_and_below_the_scans_rows(scan):
    found = Rescan(DENSE, VLP16)(scan)
    rows = DENSE.elevation_rad[:, 0]
    above, below = (rows[0] - rows[1]) / 2, (rows[-2] - rows[-1]) / 2
    outside = (VLP16.elevation_rad[:, 0] > rows[0] + above) | (VLP16.elevation_rad[:, 0] < rows[-1] - below)
    assert outside.any()
    assert found.without_rows == int(outside.sum()) * VLP16.width
    assert found.rays == VLP16.height * VLP16.width
    assert set(found.scan.ring.unique().tolist()) <= set((~outside).nonzero()[:, 0].tolist())
    assert len(found.scan) > 0.7 * (found.rays - found.without_rows)


def test_a_sensor_sees_its_own_cloud_whole_but_for_a_second_point_on_a_ray(scan):
    found = Rescan(DENSE, DENSE)(scan).scan
    image = lidargrit.project(scan, DENSE.with_columns(2048, 1))
    assert len(found) >= 0.97 * int(image.return_mask.sum())


def test_a_raised_sensor_sees_what_stands_in_front_from_its_own_frame():
    azimuth, elevation = torch.linspace(-0.3, 0.3, 105), DENSE.elevation_rad[20:60]
    directions = torch.stack(
        (elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin().expand(-1, 105)), -1
    ).reshape(-1, 3)
    wall = Scan(20 * directions)
    raised = Rescan(DENSE, DENSE, raised_m=0.5)(wall).scan
    lowest = float(wall.points_xyz_m[:, 2].min())
    assert float(raised.points_xyz_m[:, 2].min()) == pytest.approx(lowest - 0.5, abs=0.2)
    back = raised.points_xyz_m + torch.tensor([0, 0, 0.5])
    assert float(torch.cdist(back.double(), wall.points_xyz_m.double()).min(1).values.max()) < 1e-4
    both = Scan(torch.cat((20 * directions, 10 * directions[::2])))
    near = Rescan(DENSE, DENSE, raised_m=0.05)(both).scan
    assert (near.points_xyz_m.norm(dim=1) < 15).sum() > 0.8 * len(directions[::2])


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Rescan(DENSE, VLP16, raised_m=50.0), ConfigError, "raised by 50 m"),
        (lambda: Rescan(DENSE, VLP16, raised_m=math.nan), ConfigError, "raised by nan m"),
        (lambda: Rescan(DENSE, VLP16)(Scan(torch.tensor([[0.0, 0.1, 50.0]]))), ScanError, "sees no point"),
    ],
)
def test_what_no_other_sensor_can_see_gets_one_line(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_the_verb_writes_scans_that_are_read_back_and_goes_on_where_it_was_stopped(tmp_path, capsys):
    out = tmp_path / "sparse"
    words = ["rescan", "simulated:2:test", str(out), "--to", "vlp16", "--format", "ply"]
    assert main(words) == 0
    said = capsys.readouterr()
    assert "rays get a point of the first scan" in said.out + said.err
    files = sorted(out.glob("**/*.ply"))
    first = lidargrit.load_scan(files[0])
    expected = Rescan(DENSE, lidargrit.load_sensor("vlp16"))(lidargrit.simulate(seed=2_000_000)).scan
    assert abs(len(first) - len(expected)) <= 0.2 * len(expected)
    files[1].unlink()
    assert main(words) == 0
    assert len(sorted(out.glob("**/*.ply"))) == 2
    assert json.loads((out / "export.json").read_text())["to"]["name"] == "vlp16"
    assert open_source(str(out)).sensor.name == "vlp16"
    assert main([*words[:-1], "pcd"]) == 2, "the folder is of another command"
    assert "choose another folder" in capsys.readouterr().err


def test_a_command_whose_first_scan_fails_leaves_its_folder_to_a_corrected_one(tmp_path, capsys):
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans" / "000000.bin").write_bytes(b"no scan at all, of an odd length")
    words = ["rescan", str(tmp_path / "scans"), str(tmp_path / "out"), "--sensor", "os1_64", "--to"]
    assert main([*words, "vlp16"]) == 2
    assert "000000.bin" in capsys.readouterr().err
    KittiBin.write(tmp_path / "scans" / "000000.bin", lidargrit.simulate(seed=1))
    assert main([*words, "hdl32e"]) == 0
    assert open_source(str(tmp_path / "out")).sensor.name == "hdl32e"


def test_a_tree_of_a_raised_sensor_has_its_poses(tmp_path):
    sensor = lidargrit.load_sensor("hdl64e_kitti_odometry").with_columns(256)
    write_drives(tmp_path / "drive", 2, DriveConfig(sensor, seed=2_000_001, frames=2))
    change = Rescan(sensor, VLP16, raised_m=0.5)
    export_scans(f"kitti_odometry:{tmp_path / 'drive'}", tmp_path / "out", "kitti_odometry", change=change)
    low, high = (open_dataset(f"kitti_odometry:{tmp_path / name}").windows(2)[0].scans() for name in ("drive", "out"))
    for one, other in zip(low, high, strict=True):
        assert one.pose is not None
        assert other.pose is not None
        point = torch.tensor(
            [3.0, -2, 1, 1]
        ).double()  # of the second sensor's frame: half a metre higher in the first's
        torch.testing.assert_close(other.pose @ point, one.pose @ (point + torch.tensor([0, 0, 0.5, 0])))
