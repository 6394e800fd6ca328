"""Motion of the sensor undone: against a slow loop, and against the simulator's own walls and poses."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

import lidargrit
from lidargrit.cli import main
from lidargrit.core.errors import DataError, ScanError
from lidargrit.data.trajectories import read_trajectory
from lidargrit.scans.types import Scan
from lidargrit.scans.undo_motion import Trajectory, UndoMotion
from lidargrit.simulator import observe, poses_of
from lidargrit.simulator.beams import REVOLUTION_S, Beams

RNG = np.random.default_rng(0)
TIMES_S = np.array([10.0, 10.04, 10.11, 10.2])
TURNS = Rotation.from_rotvec(RNG.normal(0, 0.3, (4, 3)))
PLACES_M = RNG.normal(0, 2, (4, 3))
SEED = 0
VLP16 = lidargrit.load_sensor("vlp16").with_columns(512, 1)


def poses():
    matrices = np.tile(np.eye(4), (4, 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = TURNS.as_matrix(), PLACES_M
    return matrices


def put_tum(path):
    rows = np.column_stack((TIMES_S, PLACES_M, TURNS.as_quat()))
    np.savetxt(path, rows, fmt="%.17g", header="time x y z qx qy qz qw")
    return path


def place(time_s):
    return np.array([np.interp(time_s, TIMES_S, PLACES_M[:, axis]) for axis in range(3)])


def slowly(xyz_m, times_s, to_s):
    """Return points as seen from the pose at one time, one after the other, by SciPy's interpolation."""
    turn_at = Slerp(TIMES_S, TURNS)
    found = []
    for point, at_s in zip(xyz_m, times_s, strict=True):
        place_of = [
            np.array([np.interp(time, TIMES_S, PLACES_M[:, axis]) for axis in range(3)]) for time in (at_s, to_s)
        ]
        world = turn_at(at_s).as_matrix() @ point + place_of[0]
        found.append(turn_at(to_s).as_matrix().T @ (world - place_of[1]))
    return np.array(found)


@pytest.mark.parametrize("scan_s", [None, 10.02])
def test_points_go_where_a_loop_over_them_puts_them(scan_s):
    xyz_m, since_s = RNG.uniform(-30, 30, (300, 3)), np.linspace(0, 0.1, 300)
    times_s = since_s if scan_s else 10.05 + since_s
    scan = Scan(torch.from_numpy(xyz_m).float(), time_s=scan_s, point_time_s=torch.from_numpy(times_s))
    still, moved_m = UndoMotion(Trajectory(TIMES_S, poses()))(scan)
    expected = slowly(xyz_m, since_s + (scan_s or 10.05), scan_s or 10.05)
    np.testing.assert_allclose(still.points_xyz_m, expected, atol=2e-5)
    np.testing.assert_allclose(moved_m, np.linalg.norm(expected - xyz_m, axis=1), atol=2e-5)
    assert moved_m.max() > 0.5


def test_a_simulated_drive_is_restored_within_a_millimetre(monkeypatch):
    """Every point goes where the simulator's own ray met the street, seen from the pose at the scan's beginning."""
    cast, rays = Beams.rays, []

    def recorded(self, *ends):
        rays.append(cast(self, *ends))
        return rays[-1]

    monkeypatch.setattr(Beams, "rays", recorded)
    seen = observe(SEED, VLP16, motion=True)
    assert seen.fired_s is not None
    met = seen.clean_range_m > 0
    range_m, (origins, directions) = seen.clean_range_m[met][:, None], rays[0]
    scan = Scan(torch.from_numpy(seen.directions[met] * range_m), point_time_s=torch.from_numpy(seen.fired_s[met]))
    ends = np.stack(poses_of(SEED, (0.0, REVOLUTION_S), VLP16))
    still, moved_m = UndoMotion(Trajectory(np.array([0.0, REVOLUTION_S]), ends))(replace(scan, time_s=0.0))
    world = origins.reshape(*met.shape, 3)[met] + directions.reshape(*met.shape, 3)[met] * range_m
    expected = (world - ends[0, :3, 3]) @ ends[0, :3, :3]
    assert np.abs(still.points_xyz_m.numpy() - expected).max() < 1e-3
    assert moved_m.max() > 0.5  # the car drives


def test_a_scan_of_a_driving_simulated_car_has_the_times_of_its_points():
    still, driving = (lidargrit.simulate(SEED, VLP16, motion=motion) for motion in (False, True))
    assert still.point_time_s is None
    assert driving.point_time_s is not None
    x, y, _ = driving.points_xyz_m.double().numpy().T
    turn = np.arctan2(y, x) % (2 * np.pi) / (2 * np.pi)
    late = driving.point_time_s.numpy() / REVOLUTION_S - turn
    assert np.abs((late + 0.5) % 1 - 0.5).max() < 1 / VLP16.width


def test_the_verb_undoes_motion_by_a_file_of_poses_beside_the_scans(tmp_path, capsys):
    xyz_m, times_s = RNG.uniform(2, 30, (400, 3)).astype(np.float32), 10.05 + np.linspace(0, 0.1, 400)
    (tmp_path / "scans").mkdir()
    np.savez(tmp_path / "scans/a.npz", points=xyz_m, timestamp=times_s)
    words = ["export", f"{tmp_path}/scans", f"{tmp_path}/out", "--format", "npz", "--undo-motion"]
    assert main([*words, str(put_tum(tmp_path / "poses.txt"))]) == 0
    assert "points moved by" in capsys.readouterr().err
    with np.load(tmp_path / "out/a.npz") as after:
        np.testing.assert_allclose(after["points"], slowly(xyz_m, times_s, times_s[0]), atol=2e-5)
        np.testing.assert_array_equal(after["time"], times_s)


def test_poses_of_kitti_are_those_of_the_lidar(tmp_path):
    main(["simulate", f"{tmp_path}/drive", "-n", "3", "--frames", "3", "--sensor", "vlp16", "--seed", str(SEED)])
    known = read_trajectory(tmp_path / "drive/sequences/00")
    for known_pose, pose in zip(known.poses, way := poses_of(SEED, known.times_s.tolist(), VLP16), strict=True):
        np.testing.assert_allclose(known_pose, np.linalg.inv(way[0]) @ pose, atol=1e-6)
    with pytest.raises(DataError, match=r"12 numbers in a row and no times; .*; name .*/drive/sequences/00$"):
        read_trajectory(tmp_path / "drive/sequences/00/poses.txt")
    (tmp_path / "drive/sequences/00/poses.txt").unlink()  # KITTI's own trees have poses/00.txt alone
    np.testing.assert_array_equal(read_trajectory(tmp_path / "drive/sequences/00").poses, known.poses)


@pytest.mark.parametrize(
    ("scan", "message"),
    [
        (Scan(torch.ones(3, 3)), "no times"),
        (Scan(torch.ones(3, 3), point_time_s=torch.tensor([0.0, 0.1, 0.2])), "within the poses"),
        (Scan(torch.ones(3, 3), time_s=99.0, point_time_s=torch.tensor([0.0, 0.1, 0.2])), "a scan at 99.000 s"),
    ],
)
def test_scans_whose_motion_is_not_known_are_refused_in_one_line(scan, message):
    with pytest.raises(ScanError, match=message) as error:
        UndoMotion(Trajectory(TIMES_S, poses()))(scan)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "rows",
    [
        "",
        "1 0 0 0 0 0 0 1\n",
        "1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n",
        "1 2 3\n",
        "1 0 0 0 0 0 0 2\n2 0 0 0 0 0 0 2\n",
        "a b\n",
    ],
)
def test_files_that_hold_no_poses_are_refused_in_one_line(rows, tmp_path):
    (tmp_path / "poses.txt").write_text(rows)
    with pytest.raises(DataError) as error:
        read_trajectory(tmp_path / "poses.txt")
    assert "\n" not in str(error.value)
    with pytest.raises(DataError, match="not there"):
        read_trajectory(tmp_path / "none.txt")
