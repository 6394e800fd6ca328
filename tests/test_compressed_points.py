"""Every point comes back from a compressed file, each coordinate within half a step, or nothing does."""

import json
import os
import subprocess
import sys
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lidargrit.cli import main
from lidargrit.core.errors import ScanError
from lidargrit.data.prepared.config import DataConfig
from lidargrit.inference.compress.command import decompress_scans
from lidargrit.inference.compress.firings import Firings, turn
from lidargrit.inference.compress.fit_firings import fit_firings
from lidargrit.inference.compress.point_codec import Cloud, PointCodec
from lidargrit.inference.compress.points_command import compress_points

pytest.importorskip("constriction")
CODEC = PointCodec(20)
MOTION = (830000, 40000, 20000, -500, -1100, 2000)
COORDINATES = st.floats(-90, 90, width=32)


def whole(count: int, first: int, last: int) -> np.ndarray:
    """Return whole numbers, evenly spaced."""
    return np.linspace(first, last, count).astype(np.int64)


def revolution(motion: tuple[int, ...] = (0,) * 6) -> np.ndarray:
    """Return points (n, 3) of eight lasers that fire every 1.92 units, as the file of a driver lists them."""
    lasers, rng = 8, np.random.default_rng(2)
    height, aside = whole(lasers, 20000, 12000), np.where(np.arange(lasers) % 2, -2600, 2600)
    slope, zero = whole(lasers, 30000, -300000), np.zeros(lasers, dtype=np.int64)
    shift = rng.integers(-40, 40, lasers)
    fired = np.unique((np.arange(1562) * 1.92).astype(np.int64))
    firings = Firings(4000, fired, slope, height, aside, whole(lasers, -1500, 1500), shift, zero, np.array(motion))
    angle = firings.angles() / 4000 * 2 * np.pi
    walls_m = 12 + 3 * np.cos(3 * angle) + np.where(angle % 1.1 < 0.2, 6, 0) + rng.normal(0, 0.01, angle.shape)
    row, column = np.nonzero(rng.random(angle.shape) < 0.7)
    distance_m = walls_m[row, column]
    listed = firings.order(row, column, distance_m)
    rays, at = firings.rays(), (row[listed], column[listed])
    return np.round(rays.origin_m[at] + distance_m[listed, None] * rays.direction[at], 3).astype(np.float32)


def apart_m(one: np.ndarray, other: np.ndarray) -> float:
    """Return by how much coordinates of points in the same order differ at most."""
    assert one.shape == other.shape
    return float(np.abs(one.astype(np.float64) - other).max(initial=0))


def test_a_revolution_of_a_moving_car_comes_back_in_its_order_in_few_bits():
    points_m = revolution(MOTION)
    compressed = CODEC.compress(Cloud(points_m, None))
    assert apart_m(CODEC.decompress(compressed).points_m, points_m) <= 0.01
    shuffled = np.random.default_rng(0).permutation(points_m)
    assert len(compressed) < 0.4 * len(CODEC.compress(Cloud(shuffled, None)))  # which is coded as cells


def test_lasers_are_found_as_they_were_made():
    points_m = revolution(MOTION).astype(np.float64)
    fitted = fit_firings(points_m)
    assert fitted is not None
    rays, at = fitted.firings.rays(), (fitted.row, fitted.column)
    beside = np.cross(points_m - rays.origin_m[at], rays.direction[at])
    assert np.quantile(np.linalg.norm(beside, axis=1), 0.99) < 0.004
    assert np.abs(fitted.firings.motion[:2] - [830000, 40000]).max() < 5000


def test_a_last_laser_of_one_point_is_found():
    points_m = revolution()
    azimuth = np.arctan2(points_m[:, 1], points_m[:, 0]) % (2 * np.pi)
    last = int(np.flatnonzero(np.diff(azimuth) < -np.pi)[-1]) + 1
    cut = points_m[: last + 1]
    fitted = fit_firings(cut.astype(np.float64))
    assert fitted is not None
    assert np.bincount(fitted.row)[-1] == 1
    assert apart_m(CODEC.decompress(CODEC.compress(Cloud(cut, None))).points_m, cut) <= 0.01


def test_a_point_straight_above_the_sensor_does_not_hide_the_lasers_of_the_others():
    points_m = revolution(MOTION)
    bits = [8 * len(CODEC.compress(Cloud(each, None))) for each in (points_m, np.insert(points_m, 400, [0, 0, 1.5], 0))]
    assert bits[1] < 1.01 * bits[0]


@settings(max_examples=25, deadline=None)
@given(arrays(np.float32, st.tuples(st.integers(1, 60), st.just(3)), elements=COORDINATES), st.sampled_from([4, 20]))
def test_any_points_come_back_in_their_cells(points_m, step_mm):
    codec = PointCodec(step_mm)
    repeated = np.concatenate([points_m, points_m[: len(points_m) // 2]])
    found = codec.decompress(codec.compress(Cloud(repeated, None))).points_m
    assert len(found) == len(repeated)
    half_m = step_mm / 2000
    off_m = np.abs(found[:, None].astype(np.float64) - repeated).max(2)
    assert off_m.min(0).max() <= half_m
    assert off_m.min(1).max() <= half_m


@pytest.mark.parametrize("at", [0.0, 5e5, 3e6])
def test_points_far_away_come_back_as_near_as_32_bits_can_say(at):
    points_m = (at + np.arange(30).reshape(10, 3) * 3.7).astype(np.float32)
    found = CODEC.decompress(CODEC.compress(Cloud(points_m, None))).points_m
    assert apart_m(found[np.argsort(found[:, 0])], points_m) <= 0.01


def test_nothing_and_one_point_come_back_and_what_is_no_place_is_refused():
    for count in (0, 1):
        points_m = np.full((count, 3), 2.5, dtype=np.float32)
        assert apart_m(CODEC.decompress(CODEC.compress(Cloud(points_m, None))).points_m, points_m) <= 0.01
    with pytest.raises(ScanError, match="not finite"):
        CODEC.compress(Cloud(np.full((2, 3), np.nan, dtype=np.float32), None))
    with pytest.raises(ScanError, match="km apart"):
        CODEC.compress(Cloud(np.array([[0, 0, 0], [1e30, 0, 0]], dtype=np.float32), None))


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_altered_bytes_are_refused_in_little_memory(data):
    points_m = np.random.default_rng(1).normal(0, 20, (60, 3)).astype(np.float32)
    good = CODEC.compress(Cloud(points_m, None))
    bad = bytearray(good)
    for _ in range(data.draw(st.integers(1, 4))):
        bad[data.draw(st.integers(0, len(bad) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(bad[: data.draw(st.integers(0, len(bad)))])
    if cut == good:
        return
    tracemalloc.start()
    try:
        with pytest.raises(ScanError):
            CODEC.decompress(cut)
        assert tracemalloc.get_traced_memory()[1] < 2**30
    finally:
        tracemalloc.stop()


def test_the_angle_functions_are_right():
    turns = np.linspace(-1.5, 1.5, 1001)
    cosine, sine = turn(turns)
    assert np.abs(cosine - np.cos(2 * np.pi * turns)).max() < 2e-15
    assert np.abs(sine - np.sin(2 * np.pi * turns)).max() < 2e-15


def test_the_commands_restore_points_with_other_threads_and_instructions(tmp_path, capsys):
    points_m = revolution()
    reflectance = (np.arange(len(points_m)) % 101 / 100).astype(np.float32)
    rows = np.concatenate([points_m, reflectance[:, None]], 1)
    rows.tofile(tmp_path / "scan.bin")
    file, here, there = (str(tmp_path / name) for name in ("points.lgz", "here", "there"))
    words = ["compress", str(tmp_path / "scan.bin"), file, "--points", "--step-mm", "20"]
    assert main([*words, "--model", "pretrained_wide"]) == 2
    assert "--model with --points" in capsys.readouterr().err
    assert main(words) == 0
    assert "bits a point in steps of 20 mm" in capsys.readouterr().out
    assert main(["decompress", file, here, "--model", "pretrained"]) == 2
    assert f"got --model pretrained for {file}, which holds points; wanted no model; leave" in capsys.readouterr().err
    assert main(["decompress", file, here]) == 0
    features = "AVX512F AVX512CD AVX512_SKX AVX2 FMA3"
    environment = {**os.environ, "NPY_DISABLE_CPU_FEATURES": features, "ATEN_CPU_CAPABILITY": "default"}
    environment |= {"OMP_NUM_THREADS": "2", "PYTHONPATH": ":".join(sys.path), "PYTHONWARNINGS": "ignore"}
    command = [sys.executable, "-m", "lidargrit", "decompress", file, there]
    subprocess.run(command, env=environment, check=True, timeout=280)
    restored = np.fromfile(Path(here) / "scan.bin", np.float32).reshape(-1, 4)
    assert apart_m(restored[:, :3], points_m) <= 0.01
    assert np.array_equal(restored[:, 3], reflectance)
    assert (Path(here) / "scan.bin").read_bytes() == (Path(there) / "scan.bin").read_bytes()
    capsys.readouterr()
    assert main(["decompress", file, str(tmp_path / "images"), "--format", "image"]) == 2
    Path(file).write_bytes(Path(file).read_bytes()[:-40])
    assert main(["decompress", file, str(tmp_path / "nothing")]) == 2
    error = capsys.readouterr().err
    assert "which holds points" in error
    assert "cut off or altered" in error
    assert error.count("\n") == 2


def test_what_a_folder_holds_besides_is_told_and_a_step_that_no_command_takes_is_refused(tmp_path, heard):
    file, folder = tmp_path / "points.lgz", tmp_path / "scans"
    folder.mkdir()
    np.eye(4, dtype=np.float32)[:3].tofile(folder / "scan.bin")
    (folder / "more.laz").write_bytes(b"of another program")
    compress_points(str(folder), file, 20, DataConfig())
    assert any("1 file .laz beside 1 that are read left out" in line for line in heard)
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members["header.json"] = json.dumps({**json.loads(members["header.json"]), "step_mm": 10**300}).encode()
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    with pytest.raises(ScanError, match="not those of the machine"):
        decompress_scans(file, tmp_path / "out", None, None, [])


@pytest.mark.shared
def test_a_real_scan_comes_back_in_its_order_in_fewer_than_4_5_bits_a_point(real):
    file = min((real / "kitti_odometry/sequences/00").rglob("*.bin"))
    rows = np.fromfile(file, np.float32).reshape(-1, 4)
    bare = CODEC.compress(Cloud(rows[:, :3], None))
    assert 8 * len(bare) / len(rows) < 4.5
    assert apart_m(CODEC.decompress(bare).points_m, rows[:, :3]) <= 0.01
