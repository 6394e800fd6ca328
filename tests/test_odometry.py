"""Odometry of drives: errors of paths against an independent computation, and KISS-ICP itself where it is installed."""

import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidargrit.cli import main
from lidargrit.core.errors import ConfigError
from lidargrit.data.drives import DriveConfig, write_drives
from lidargrit.evaluation.odometry import kiss_icp_is_there, path_by_kiss_icp, path_errors
from lidargrit.scans.sensors import load_sensor

COLUMNS = ["--set", "data.columns=128", "data.column_stride=4"]


def path(count: int, seed: int, step_m: float = 0.8) -> tuple[list[Rotation], np.ndarray, np.ndarray]:
    """Return a path that wanders: its turns, its places, and both as matrices."""
    rng = np.random.default_rng(seed)
    turns, places = [Rotation.from_rotvec(rng.normal(0, 0.5, 3))], [rng.normal(0, 5, 3)]
    for _ in range(count - 1):
        places.append(places[-1] + turns[-1].apply(rng.normal((step_m, 0, 0), 0.05)))
        turns.append(turns[-1] * Rotation.from_rotvec(rng.normal(0, 0.03, 3)))
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = [turn.as_matrix() for turn in turns], places
    return turns, np.array(places), poses


def apart_m(one: tuple, other: tuple, first: int, last: int) -> float:
    """How far two motions are apart, each in the frame that it leads to: |R_b^T (a - b)| with turns kept apart."""
    (of, to), (of_other, to_other) = ((way[0][first].inv(), way[1][last] - way[1][first]) for way in (one, other))
    return float(np.linalg.norm(of.apply(to) - of_other.apply(to_other)))


def test_errors_of_a_path_are_those_of_a_computation_by_turns_and_places():
    true, estimated = path(16, 0), path(16, 1)
    found = path_errors(estimated[2], true[2])
    assert found.steps_m == pytest.approx([apart_m(estimated, true, at, at + 1) for at in range(10, 15)])
    way_m = sum(np.linalg.norm(true[1][at + 1] - true[1][at]) for at in range(10, 15))
    assert found.drift == pytest.approx(apart_m(estimated, true, 10, 15) / way_m)
    assert len(path_errors(estimated[2], true[2], settling=0).steps_m) == 15


def test_where_both_paths_begin_does_not_count_and_a_standing_car_has_no_error():
    _, _, true = path(14, 0)
    moved = np.linalg.inv(true[3]) @ true  # the same path in another frame
    found = path_errors(moved, true)
    assert max(found.steps_m) < 1e-12
    assert found.drift < 1e-12
    still = np.tile(np.eye(4), (14, 1, 1))
    assert path_errors(true, still).steps_m == []
    assert np.isnan(path_errors(true, still).drift)


@pytest.fixture(scope="module")
def drives(tmp_path_factory) -> Path:
    """One street of 13 scans by few columns, whose car moves."""
    folder = tmp_path_factory.mktemp("drives")
    write_drives(folder, 13, DriveConfig(load_sensor("hdl64e_kitti_odometry").with_columns(128), 2_000_001, 13))
    return folder


def test_without_the_package_the_table_says_how_to_install_it(drives, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("LIDARGRIT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setitem(sys.modules, "kiss_icp", None)
    monkeypatch.delitem(sys.modules, "kiss_icp.kiss_icp", raising=False)
    with pytest.raises(ConfigError, match=r"pip install 'lidargrit\[odometry\]'"):
        path_by_kiss_icp([np.zeros((3, 3))])
    assert main(["evaluate", str(drives), "--protocol", "drive", "-n", "1", *COLUMNS]) == 0
    printed = capsys.readouterr().out
    assert "no odometry without KISS-ICP: pip install 'lidargrit[odometry]'" in printed
    assert "its drift" not in printed


def test_drives_too_short_for_any_pair_have_a_row_without_numbers(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("LIDARGRIT_CACHE", str(tmp_path / "cache"))
    write_drives(tmp_path / "two", 2, DriveConfig(load_sensor("hdl64e_kitti_odometry").with_columns(128), 0, 2))
    assert main(["evaluate", str(tmp_path / "two"), "--protocol", "drive", *COLUMNS]) == 0
    assert capsys.readouterr().out.splitlines()[1].split()[1:4] == ["2", "nan", "nan"]


class _SameStep:
    """In place of KISS-ICP: a car that goes half a metre straight ahead from scan to scan."""

    def __init__(self, config: SimpleNamespace) -> None:
        assert config.registration.max_num_threads == 1
        self.last_pose, self._next = np.eye(4), np.eye(4)

    def register_frame(self, points_m: np.ndarray, times_s: np.ndarray) -> None:
        assert points_m.shape[1:] == (3,)
        assert points_m.dtype == np.float64
        assert len(times_s) == 0
        self.last_pose, self._next = self._next.copy(), self._next + np.array([[0, 0, 0, 0.5]] + [[0] * 4] * 3)


def test_the_table_has_the_errors_of_the_path_that_the_package_makes(drives, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("LIDARGRIT_CACHE", str(tmp_path / "cache"))
    for name, holds in (
        ("kiss_icp", {}),
        ("kiss_icp.config", {"load_config": lambda _: SimpleNamespace(registration=SimpleNamespace())}),
        ("kiss_icp.kiss_icp", {"KissICP": _SameStep}),
    ):
        module = ModuleType(name)
        vars(module).update(holds)
        monkeypatch.setitem(sys.modules, name, module)
    file = tmp_path / "scores.json"
    assert main(["evaluate", str(drives), "--protocol", "drive", "-n", "1", "--json", str(file), *COLUMNS]) == 0
    (found,) = json.loads(file.read_text())["sets"]
    rows = np.loadtxt(drives / "sequences/00/poses.txt").reshape(-1, 3, 4)  # of a camera: z ahead, x right, y down
    places, turns = rows[:, :, 3], Rotation.from_matrix(rows[:, :, :3])
    moves = [turns[at].inv().apply(places[at + 1] - places[at]) - [0, 0, 0.5] for at in (10, 11)]
    assert found["odometry_step_m"]["value"] == pytest.approx(np.linalg.norm(moves, axis=1).mean(), abs=1e-6)
    way_m = np.linalg.norm(np.diff(places[10:], axis=0), axis=1).sum()
    end = turns[10].inv().apply(places[12] - places[10]) - [0, 0, 1.0]
    assert found["odometry_drift"]["value"] == pytest.approx(np.linalg.norm(end) / way_m, abs=1e-6)
    assert "odometry, a step [m]" in capsys.readouterr().out


@pytest.mark.skipif(not kiss_icp_is_there(), reason="needs the package kiss-icp")
def test_kiss_icp_follows_a_moving_sensor():
    rng, turn = np.random.default_rng(0), Rotation.from_euler("z", 0.01)
    street = rng.uniform((-60, -12, -2), (60, 12, 6), (60_000, 3))
    side = rng.integers(0, 3, len(street))
    street[side == 0, 1], street[side == 1, 1], street[side == 2, 2] = -12, 12, -2
    gable = rng.random(len(street)) < 0.3  # without which the street is alike along itself
    street[gable, 0] = 6 * np.round(street[gable, 0] / 6)
    poses = [np.eye(4)]
    for _ in range(13):
        step = np.eye(4)
        step[:3, :3], step[0, 3] = turn.as_matrix(), 0.6
        poses.append(poses[-1] @ step)
    seen = [(street - pose[:3, 3]) @ pose[:3, :3] for pose in poses]
    found = path_errors(path_by_kiss_icp(seen), np.array(poses))
    assert max(found.steps_m) < 0.03
    assert found.drift < 0.03
    assert np.array_equal(path_by_kiss_icp(seen), path_by_kiss_icp(seen))
