"""The page on CARLA: its lines of Python save what CARLA's LiDAR sends so that every ray has a pixel of its own."""

import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

import lidargrit
from lidargrit.cli import main
from lidargrit.scans.projection.unfolding import rings_from_firing_order

PAGE = Path(__file__).resolve().parents[1] / "docs" / "how-to" / "carla.md"
CHANNELS, COLUMNS, UPPER_DEG, LOWER_DEG = 64, 1024, 2.0, -24.8


def measured(wall_right_m):
    """Return the bytes that CARLA sends of one revolution: channel by channel, from straight behind to the right.

    Angles, order and hand as in RayCastSemanticLidar.cpp of CARLA 0.9: yaw from -180 degrees, positive to the right.
    """
    elevation = np.radians(UPPER_DEG - np.arange(CHANNELS)[:, None] * (UPPER_DEG - LOWER_DEG) / (CHANNELS - 1))
    yaw = np.radians(-180 + 360 * np.arange(COLUMNS) / COLUMNS)[None]
    range_m = np.where(np.sin(yaw) > 0.5, wall_right_m, 20.0) * np.ones_like(elevation)
    x, right = range_m * np.cos(elevation) * np.cos(yaw), range_m * np.cos(elevation) * np.sin(yaw)
    rows = np.stack((x, right, range_m * np.sin(elevation), np.exp(-0.004 * range_m)), axis=-1)
    return rows.astype(np.float32).tobytes()


def lines_of_page():
    return re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


def test_the_pages_lines_give_one_point_to_every_pixel_and_keep_left_and_right(tmp_path, monkeypatch):
    record, describe, _ = lines_of_page()
    monkeypatch.setitem(sys.modules, "carla", ModuleType("carla"))
    monkeypatch.chdir(tmp_path)
    recording: dict = {}
    exec(record, recording)
    recording["save_scan"](SimpleNamespace(raw_data=measured(wall_right_m=5.0), frame=42), tmp_path)
    exec(describe, {})
    sensor = lidargrit.load_sensor("carla.json")
    image = lidargrit.project(lidargrit.load_scan("000042.npy"), sensor)
    assert image.return_mask.all()
    right = torch.sin(sensor.azimuth_rad[0]) < -0.51  # azimuth is positive to the left
    assert torch.allclose(image.range_m[:, right], torch.tensor(5.0))
    assert torch.allclose(image.range_m[:, torch.sin(sensor.azimuth_rad[0]) > -0.49], torch.tensor(20.0))


@pytest.mark.filterwarnings("ignore:.*have fewer columns")
def test_the_callback_keeps_some_of_the_points_as_they_are_and_turns_right_to_left():
    callback: dict = {}
    exec(lines_of_page()[2], callback)
    raw = measured(wall_right_m=5.0)
    kept = callback["on_scan"](SimpleNamespace(raw_data=raw))
    sent = {row.tobytes() for row in np.frombuffer(raw, np.float32).reshape(-1, 4) * np.float32([1, -1, 1, 1])}
    assert {row.tobytes() for row in kept} < sent
    assert 0.3 < len(kept) / (CHANNELS * COLUMNS) < 1
    across = np.hypot(*kept[:, :2].T)
    assert (across[kept[:, 1] < -0.55 * across] < 5.1).all(), "the wall is on the right, which is negative y"


@pytest.mark.parametrize("name", ["I", "CosAngle"])
def test_files_that_carla_saves_are_read_with_y_to_the_left_and_said_so(name, tmp_path):
    rows = np.frombuffer(measured(wall_right_m=5.0), np.float32).reshape(-1, 4)[::50]
    lines = ["ply", "format ascii 1.0", f"element vertex {len(rows)}"]
    lines += [f"property float32 {axis}" for axis in ("x", "y", "z", name)]
    text = "\n".join([*lines, "end_header", *(" ".join(f"{value:.4f}" for value in row) for row in rows), ""])
    (tmp_path / "carla.ply").write_text(text)
    scan = lidargrit.load_scan(tmp_path / "carla.ply")
    assert torch.allclose(scan.points_xyz_m, torch.from_numpy(rows[:, :3] * np.float32([1, -1, 1])), atol=1e-3)
    assert any("left-handed" in note for note in scan.notes)
    (tmp_path / "other.ply").write_text(text.replace("float32", "float"))
    other = lidargrit.load_scan(tmp_path / "other.ply")
    assert torch.allclose(other.points_xyz_m, torch.from_numpy(rows[:, :3].copy()), atol=1e-3)
    assert not any("left-handed" in note for note in other.notes)


def rows_of_a_street():
    rows = np.frombuffer(measured(wall_right_m=5.0), np.float32).reshape(-1, 4)[::7]
    noise = np.random.default_rng(0).normal(1, 0.001, len(rows))  # along the ray; CARLA's intensity knows none of it
    return (rows * np.c_[np.repeat(noise[:, None], 3, axis=1), np.ones(len(rows))]).astype(np.float32)


def saved(path, rows):
    if path.suffix == ".bin":
        path.write_bytes(rows.tobytes())
    elif path.stem == "semantic":
        kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("CosAngle", "<f4"), ("ObjIdx", "<u4"), ("ObjTag", "<u4")]
        np.save(path, np.array([(*row, 1, 2) for row in rows.tolist()], kinds))
    else:
        np.save(path, rows)
    return path


@pytest.mark.parametrize("name", ["raw.npy", "raw.bin", "semantic.npy"])
def test_what_carla_sends_is_read_with_y_to_the_left_however_it_is_saved(name, tmp_path):
    rows = rows_of_a_street()
    left = torch.from_numpy(rows[:, :3] * np.float32([1, -1, 1]))
    scan = lidargrit.load_scan(saved(tmp_path / name, rows))
    assert torch.equal(scan.points_xyz_m, left)
    assert scan.notes[-1].startswith("files of CARLA, left-handed")
    # Whoever mirrored the points before saving them has y to the left already.
    before = lidargrit.load_scan(saved(tmp_path / name, rows * np.float32([1, -1, 1, 1])))
    assert torch.equal(before.points_xyz_m, left)
    assert before.notes == ()
    if "semantic" not in name:
        rows[:, 3] = np.random.default_rng(1).permutation(rows[:, 3])  # as bright, but of no range: another sensor
        assert torch.equal(lidargrit.load_scan(saved(tmp_path / name, rows)).points_xyz_m[:, 1], left[:, 1].neg())


@pytest.mark.parametrize("suffix", [".npy", ".bin", ".ply"])
def test_completed_scans_of_carla_keep_left_and_right(suffix, tmp_path):
    rows = rows_of_a_street()
    path = tmp_path / f"scan{suffix}"
    if suffix == ".ply":
        lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
        lines += [f"property float32 {axis}" for axis in "xyzI"]
        path.write_bytes("\n".join([*lines, "end_header\n"]).encode() + rows.tobytes())
    else:
        saved(path, rows)
    words = ["--sensor", "hdl64e_kitti_odometry", "--model", "nearest", "--projection", "spherical"]
    assert main(["complete", str(path), str(tmp_path / "out"), *words]) == 0
    done = lidargrit.load_scan(tmp_path / "out" / f"scan{suffix}")
    own, added = done.points_xyz_m[~done.filled], done.points_xyz_m[done.filled]
    assert torch.equal(own, torch.from_numpy(rows[:, :3] * np.float32([1, -1, 1])))
    for points in (own, added):  # the wall on the right is near
        across = points[:, :2].norm(dim=1)
        ahead_right, ahead_left = (points[:, 1] * side > 0.8 * across for side in (-1, 1))
        assert across[ahead_right].median() < 6 < across[ahead_left].median()


@pytest.mark.parametrize("dropped", [0, 1])
def test_equally_long_rings_that_begin_behind_are_as_many_as_there_are(dropped):
    """The seam ahead cuts each of 64 into two halves, which made 65 of them."""
    points = np.frombuffer(measured(wall_right_m=5.0), np.float32).reshape(-1, 4)[dropped:, :3].T
    ring = rings_from_firing_order(np.ascontiguousarray(points))
    own = np.repeat(np.arange(CHANNELS), COLUMNS)[dropped:]
    assert ring.max() + 1 == CHANNELS + dropped, "rings of other lengths are told by the seam alone"
    assert (ring == own).all() == (dropped == 0)
