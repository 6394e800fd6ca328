"""A page of clouds shows every point, also those without a pixel of their own, or counts those that it hides."""

from pathlib import Path

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.data import formats
from lidargrit.data.formats import read_scan
from lidargrit.scans.projection import unproject
from lidargrit.scans.types import Scan
from test_view_page import SENSOR, page_data, scans, unpacked, words


@pytest.fixture(scope="module")
def cloud(tmp_path_factory) -> Path:
    """A completed cloud with points that share a pixel, and others that no row looks at."""
    folder = tmp_path_factory.mktemp("cloud")
    scan = unproject(scans(SENSOR.with_columns(2048, 8).fine(), 1)[0])
    twins, above = scan.points_xyz_m[:700] * 1.01, scan.points_xyz_m[:50] * 1.0
    above[:, 2] = above[:, :2].norm(dim=1)
    points = torch.cat((scan.points_xyz_m, twins, above))
    filled = torch.arange(len(points)) % 3 == 0
    ring = torch.cat((scan.ring, scan.ring[:750]))
    reflectance = torch.linspace(0, 1, len(points))
    write_npz = next(one for one in formats.candidates(folder / "a.npz")).write
    write_npz(folder / "a.npz", Scan(points, reflectance, ring, filled=filled))
    return folder


def test_points_beside_the_pixels_are_bounded_and_the_others_counted(cloud, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("lidargrit.viewer.scan_sets._BESIDE_AT_MOST", 100)
    out, scan = tmp_path / "v.html", read_scan(cloud / "a.npz")
    words_of = ["view", str(cloud), "-o", str(out), "--projection", "spherical", "--sensor", "hdl64e_kitti_odometry"]
    assert main(words_of) == 0
    (one,) = page_data(out.read_text(encoding="utf-8"))["sources"][0]["scans"]
    in_pixels = int((unpacked(one["range"], "<u2") > 0).sum())
    assert len(unpacked(one["beside"], "<f4")) == 3 * 100
    assert one["hidden"] == len(scan) - in_pixels - 100 > 0
    assert f"{one['hidden']:,} of {len(scan):,} points are hidden, since a page shows 100 points beside" in (
        capsys.readouterr().err
    )


@pytest.mark.parametrize("options", [[], ["--set", "data.columns=256"]])
def test_every_point_is_shown_or_counted_as_hidden(cloud, options, tmp_path, capsys, browser):
    out, scan = tmp_path / "v.html", read_scan(cloud / "a.npz")
    words_of = ["view", str(cloud), "-o", str(out), "--projection", "spherical", "--sensor", "hdl64e_kitti_odometry"]
    assert main([*words_of, *options]) == 0
    (source,) = page_data(out.read_text(encoding="utf-8"))["sources"]
    (one,), told = source["scans"], capsys.readouterr().err
    in_pixels = int((unpacked(one["range"], "<u2") > 0).sum())
    filled = unpacked(one["filled"], "u1")
    browser.open(out)
    about = words(browser, "about")[0]
    if options:
        assert (one["hidden"], "beside" in one) == (len(scan) - in_pixels, False)
        assert f"{one['hidden']:,} of {len(scan):,} points are hidden, since each pixel of 64x256 shows one" in told
        assert f"{one['hidden']:,} more are hidden" in about
        assert filled.sum() < scan.filled.sum()
        return
    beside = unpacked(one["beside"], "<f4").reshape(-1, 3)
    assert (len(beside), one["hidden"]) == (len(scan) - in_pixels, 0)
    assert len(beside) >= 750
    assert "hidden" not in told + about
    measured = len(scan) - int(scan.filled.sum())
    assert f": {len(scan):,} points, from " in about
    assert (
        f"; {measured:,} were measured and {len(scan) - measured:,} filled in by a model; {len(beside)} of all" in about
    )
    seen = np.array(browser.run("[...page.panes[0].points]")).reshape(-1, 4)
    assert int(seen[:, 3].sum()) == len(scan)
    assert np.array_equal(seen[-len(beside) :, :3].astype("f4"), beside)
    assert {tuple(row) for row in beside.tolist()} <= {tuple(row) for row in scan.points_xyz_m.tolist()}
    assert int(filled.sum()) == int(scan.filled.sum())
    browser.run("document.querySelector('#mode').value = 'filled'; page.paint()")
    colours = np.array(browser.run("[...new Uint8Array(page.panes[0].drawer.colours.buffer)]")).reshape(-1, 4)[
        -len(beside) :, :3
    ]
    warmth = colours[:, 0] - colours[:, 2]
    marks = filled[-len(beside) :] == 1
    assert warmth[marks].min() > 60, "filled points are orange"
    assert warmth[~marks].max() < 20, "measured ones are not"
    assert browser.troubles() == []
