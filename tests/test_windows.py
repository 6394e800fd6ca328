"""Windows of drives: their order, times and poses, of simulated drives and of a recorded one."""

import numpy as np
import pytest
import torch

from lidargrit.core.errors import ConfigError, DataError
from lidargrit.data.datasets import open_dataset
from lidargrit.data.drives import DriveConfig, write_drives
from lidargrit.scans.sensors import load_sensor
from lidargrit.simulator import FRAME_S, poses_of

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(128)


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """Two streets of three scans each."""
    folder = tmp_path_factory.mktemp("drives")
    write_drives(folder, 6, DriveConfig(SENSOR, seed=5, frames=3))
    return folder


def test_windows_of_simulated_drives_are_in_order_and_stay_within_a_drive(drives):
    scans = open_dataset(f"kitti_odometry:{drives}:all")
    assert [window.indices for window in scans.windows(2)] == [(0, 1), (1, 2), (3, 4), (4, 5)]
    assert [window.indices for window in scans.windows(3)] == [(0, 1, 2), (3, 4, 5)]
    assert scans.windows(4) == []
    for window, seed in zip(scans.windows(3), (5, 6), strict=True):
        poses, found = poses_of(seed, [FRAME_S * frame for frame in range(3)], SENSOR), window.scans()
        assert [scan.time_s for scan in found] == pytest.approx([0, 0.1, 0.2])
        for frame, scan in enumerate(found):
            moved = np.linalg.inv(poses[0]) @ poses[frame]
            assert scan.pose is not None
            assert np.allclose(scan.pose.numpy(), moved, atol=1e-6)
            assert torch.equal(scan.points_xyz_m, scans.scan(window.indices[frame]).points_xyz_m)


def test_streets_that_are_seen_once_each_make_no_window(tmp_path):
    write_drives(tmp_path, 2, DriveConfig(SENSOR, frames=1))
    assert open_dataset(f"kitti_odometry:{tmp_path}:all").windows(1) == []


def test_scans_without_known_times_make_no_window():
    scans = open_dataset("simulated:2:test")
    assert scans.windows(1) == []
    assert scans.scan(0).time_s is None
    assert scans.scan(0).pose is None
    with pytest.raises(ConfigError, match="got windows of 0 scans; wanted at least 1"):
        scans.windows(0)


@pytest.mark.shared
def test_poses_of_a_recorded_drive_are_the_sensors_in_the_frame_of_its_first_scan(real):
    folder = real / "semantic_kitti"
    windows = open_dataset(f"kitti_odometry:{folder}:all").windows(16)
    assert [window.indices for window in windows] == [tuple(range(16))]
    scans = windows[0].scans()
    sequence = folder / "sequences" / "00"
    assert [scan.time_s for scan in scans] == pytest.approx(np.loadtxt(sequence / "times.txt")[:16])
    rows = [line.split()[1:] for line in (sequence / "calib.txt").read_text().splitlines() if line.startswith("Tr")]
    rotation, shift = np.split(np.array(rows[0], float).reshape(3, 4), [3], 1)
    point = np.array([[20.0], [-3.0], [-1.0]])
    for scan, camera in zip(scans, np.loadtxt(sequence / "poses.txt").reshape(-1, 3, 4), strict=False):
        in_first_camera = camera[:, :3] @ (rotation @ point + shift) + camera[:, 3:]
        in_first_scan = np.linalg.solve(rotation, in_first_camera - shift)  # step by step, as the readme says
        assert scan.pose is not None
        assert np.allclose((scan.pose.numpy() @ np.append(point, 1))[:3], in_first_scan[:, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("times.txt", "0.0\nsoon\n", "got a row of .*times.txt with something else; wanted one finite number"),
        ("times.txt", "0.0\n0.0\n", "got times that do not rise in"),
        ("times.txt", "nan\n", "that is not finite"),
        ("poses.txt", "1 0 0\n", "got a row of .*poses.txt with something else; wanted 12 finite numbers"),
        ("calib.txt", "P0: 1\n", "calib.txt without a pose 'Tr:'"),
        ("calib.txt", f"Tr: {'0 ' * 12}\n", "calib.txt without a pose 'Tr:'"),
    ],
)
def test_a_damaged_file_of_times_or_poses_is_refused_where_it_is_needed(file, content, message, tmp_path):
    write_drives(tmp_path, 2, DriveConfig(SENSOR, frames=2))
    (tmp_path / "sequences" / "00" / file).write_text(content)
    scans = open_dataset(f"kitti_odometry:{tmp_path}:all")
    assert len(scans.scan(0)) > 0
    with pytest.raises(DataError, match=message):
        scans.windows(1)


def test_scans_and_times_that_are_added_to_a_drive_are_read(tmp_path):
    for count in (2, 3):
        write_drives(tmp_path, count, DriveConfig(SENSOR, seed=2_000_001, frames=3))
        (window,) = open_dataset(f"kitti_odometry:{tmp_path}").windows(count)
        assert len(window.indices) == count
        scan = tmp_path / f"raw/d/velodyne_points/data/{count - 2:010d}.bin"
        scan.parent.mkdir(parents=True, exist_ok=True)
        scan.write_bytes((tmp_path / "sequences/00/velodyne/000000.bin").read_bytes())
        times = "".join(f"2011-09-26 13:02:2{number}\n" for number in range(count - 1))
        (scan.parents[1] / "timestamps.txt").write_text(times)
        assert open_dataset(f"{tmp_path / 'raw'}").motion(count - 2).time_s == count - 2
