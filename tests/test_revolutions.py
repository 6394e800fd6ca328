"""Files of more than one revolution, and range images of steps and rows that nothing tells: said aloud."""

import numpy as np
import pytest
import torch
from PIL import Image

from lidargrit.cli import main
from lidargrit.data.formats import read_scan
from lidargrit.scans.fit_sensor import fit_sensor
from lidargrit.scans.projection.inspection import inspect
from lidargrit.scans.projection.revolutions import revolutions, told_revolutions
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import Scan
from street_corner import COLUMNS, corner, xyz_of


def turned(turns, by_column=True):
    """Return a scan of so many revolutions in the order of firing, the second seen from 1 m further on."""
    parts, rings = [], []
    for at in range(int(np.ceil(turns))):
        table = corner(at)
        points, ring = xyz_of(table).numpy(), table["ring"].astype(np.int64)
        column = np.floor((np.pi - np.arctan2(points[:, 1], points[:, 0])) / (2 * np.pi) * COLUMNS)
        order = column.argsort(kind="stable") if by_column else np.arange(len(ring))
        order = order[column[order] < COLUMNS * (turns - at)]
        parts.append(points[order] + np.float32([0.01 * at, 0, 0]))
        rings.append(ring[order])
    return Scan(torch.from_numpy(np.concatenate(parts)), None, torch.from_numpy(np.concatenate(rings)), source="a.mcap")


@pytest.mark.parametrize("turns", [1.5, 2, 1.1])
def test_more_than_one_revolution_is_told(turns, tmp_path, capsys):
    scan = turned(turns)
    assert revolutions(scan) == pytest.approx(turns, abs=0.03)
    told = told_revolutions(scan)
    assert "revolutions in a.mcap" in told
    assert told in inspect(scan, load_sensor("vlp16").with_columns(COLUMNS)).problems
    assert told in fit_sensor([scan]).warnings
    np.savez(tmp_path / "a.npz", points=scan.points_xyz_m.numpy(), ring=scan.ring.numpy())
    words = [
        "prepare",
        str(tmp_path / "a.npz"),
        "-o",
        str(tmp_path / "p"),
        "--sensor",
        "vlp16",
        "--set",
        "data.columns=90",
    ]
    assert main(words) == 0
    output = capsys.readouterr()
    assert "WARNING: " in output.out + output.err
    assert "give one revolution a scan" in output.out + output.err


@pytest.mark.parametrize("by_column", [True, False])
def test_one_revolution_is_not_doubted(by_column):
    assert told_revolutions(turned(1, by_column)) == ""


def test_shuffled_points_tell_no_revolutions():
    scan = turned(2)
    order = torch.randperm(len(scan), generator=torch.Generator().manual_seed(0))
    assert revolutions(Scan(scan.points_xyz_m[order], None, scan.ring[order])) is None
    assert revolutions(Scan(scan.points_xyz_m[order])) is None
    assert revolutions(Scan(turned(1, by_column=False).points_xyz_m)) is None, "ring by ring"


@pytest.mark.parametrize("turns", [1, 1.5, 2])
def test_revolutions_are_counted_without_rings(turns):
    scan = Scan(turned(turns).points_xyz_m)
    assert revolutions(scan) == pytest.approx(turns, abs=0.03)
    assert bool(told_revolutions(scan)) is (turns > 1)


@pytest.mark.parametrize("order", ["one after the other", "all first, then all last"])
def test_two_returns_of_a_beam_are_told(order):
    points = turned(1).points_xyz_m
    pairs = torch.stack([points, points * 1.05])
    pairs = pairs.transpose(0, 1) if order == "one after the other" else pairs
    told = told_revolutions(Scan(pairs.reshape(-1, 3)))
    if order == "one after the other":
        assert told.startswith("50% of the points of a scan lie behind or before another of the same beam: two returns")
    else:
        assert "revolutions in a scan: 50% of the points" in told, "they are stored like two"
    assert told in inspect(Scan(pairs.reshape(-1, 3)), load_sensor("vlp16").with_columns(COLUMNS)).problems
    assert told_revolutions(Scan(points)) == ""


@pytest.mark.parametrize(("columns", "is_told"), [(512, True), (870, False)])
def test_the_steps_and_rows_that_a_png_is_taken_to_have_are_told(tmp_path, columns, is_told, capsys):
    Image.fromarray(np.full((64, columns), 500, np.uint16)).save(tmp_path / "a.png")
    scan = read_scan(tmp_path / "a.png")
    assert bool(scan.notes) is is_told
    assert main(["inspect", str(tmp_path / "a.png")]) == 0
    told = "note: taken as steps of 2 mm and rows from +1.94 to -25 degrees" in capsys.readouterr().out
    assert told is is_told
