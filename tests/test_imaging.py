"""Scans whose points are in no firing order, or of another sensor: recognised, projected by elevation, or refused."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidargrit import cli
from lidargrit.core.errors import ConfigError, ScanError
from lidargrit.data import formats
from lidargrit.data.prepared.config import DataConfig, ScanSettings
from lidargrit.data.sources import open_source
from lidargrit.evaluation.pairs import EvalSet, pair_for_protocol
from lidargrit.evaluation.protocols import load_protocol
from lidargrit.scans.projection import inspect, project, projection_that_fits
from lidargrit.scans.projection.sensor_check import doubts_about_rays
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import Scan
from lidargrit.simulator import simulate
from lidargrit.viewer.scan_sets import load_scan_sets

HDL64E = load_sensor("hdl64e_kitti_odometry")


@pytest.fixture(scope="module")
def fired() -> Scan:
    """Return a simulated scan in firing order, without the ring of its points, as a ``.bin`` holds it."""
    return replace(simulate(seed=3), ring=None, label=None)


def reordered(scan: Scan, order: np.ndarray) -> Scan:
    index = torch.from_numpy(order.copy())
    return replace(scan, points_xyz_m=scan.points_xyz_m[index], reflectance=scan.reflectance[index])


def orders(scan: Scan) -> dict[str, np.ndarray]:
    """Return what is not KITTI's order: at random, column by column, and ring by ring from the lowest up."""
    x, y, z = scan.points_xyz_m.double().numpy().T
    azimuth = np.round(np.arctan2(y, x), 3)
    return {
        "shuffled": np.random.default_rng(0).permutation(len(scan)),
        "by column": np.lexsort((z, azimuth)),
        "upside down": np.argsort(np.round(np.arctan2(z, np.hypot(x, y)), 3), kind="stable"),
    }


@pytest.fixture(scope="module")
def folders(fired, tmp_path_factory):
    """Write the same two scans in firing order and shuffled."""
    root = tmp_path_factory.mktemp("orders")
    mirrored = replace(fired, points_xyz_m=fired.points_xyz_m * torch.tensor([-1.0, -1.0, 1.0]))
    start = np.argsort(mirrored.points_xyz_m[:, 1].numpy() < 0, kind="stable")  # each ring from straight ahead again
    ring = project_rows(mirrored)[start]
    mirrored = reordered(mirrored, start[np.argsort(ring, kind="stable")])
    for name, order in (("fired", np.arange), ("shuffled", np.random.default_rng(1).permutation)):
        for index, scan in enumerate((fired, mirrored)):
            path = root / name / f"{index:06d}.bin"
            path.parent.mkdir(exist_ok=True)
            formats.load("kitti_bin").write(path, reordered(scan, order(len(scan))))
    return root


def project_rows(scan: Scan) -> np.ndarray:
    rays = HDL64E.elevation_rad[:, 0].double()
    x, y, z = scan.points_xyz_m.double().unbind(dim=1)
    return (torch.atan2(z, torch.hypot(x, y))[:, None] - rays).abs().argmin(dim=1).numpy()


def test_orders_that_are_none_of_firing_are_recognised(fired):
    assert projection_that_fits(fired, HDL64E) == "unfolding"
    by_ring = project(fired, HDL64E)
    for name, order in orders(fired).items():
        scan = reordered(fired, order)
        assert projection_that_fits(scan, HDL64E) == "spherical", name
        image = project(scan, HDL64E, "spherical")
        assert (image.return_mask == by_ring.return_mask).float().mean() > 0.999, name
        for variant in ("exact", "reference"):
            with pytest.raises(ScanError, match=r"project by elevation: --projection spherical"):
                project(scan, HDL64E, variant=variant)
            assert inspect(scan, HDL64E, variant=variant).problems, (name, variant)


def test_a_cut_sweep_is_refused_as_before_and_not_taken_for_another_order(fired):
    cut = reordered(fired, np.arange(len(fired) // 2))
    assert projection_that_fits(cut, HDL64E) == "unfolding"
    with pytest.raises(ScanError, match=r"rings in .*; wanted the 64 rings .*fit-sensor"):
        project(cut, HDL64E)


@pytest.mark.parametrize("protocol", ["exact", "lidargrit-kitti-odometry"])
def test_a_shuffled_set_is_compared_as_if_it_were_in_order(folders, protocol, heard):
    """Scored without a word before: rows by an order that there is not."""
    names = [str(folders / name) for name in ("shuffled", "fired")]
    pair = pair_for_protocol(*map(open_source, names), load_protocol(protocol), DataConfig())
    assert sum("not in firing order" in line and names[0] in line for line in heard) == 1
    ours, theirs = pair.samples.batch([0, 1]), pair.reference.batch([0, 1])
    assert torch.equal(ours.range_m, theirs.range_m)
    by_ring = open_source(names[1]).images(HDL64E).batch([0, 1])
    assert (ours.return_mask == by_ring.return_mask).float().mean() > 0.999
    swapped = pair_for_protocol(*map(open_source, names[::-1]), load_protocol(protocol), DataConfig())
    assert torch.equal(swapped.samples.batch([0, 1]).range_m, ours.range_m)
    assert {each.projection_variant for each in (swapped.samples, swapped.reference)} == {"exact"}


def test_a_window_keeps_reflectance_and_labels_of_what_it_keeps():
    images = open_source("simulated:1:test").images(HDL64E)
    whole, near = (EvalSet("a", images, [0], window).batch([0]) for window in (None, (5.0, 20.0)))
    assert whole.label is not None
    assert whole.reflectance is not None
    assert near.label is not None
    assert near.reflectance is not None
    assert 0 < near.return_mask.sum() < whole.return_mask.sum()
    assert torch.equal(near.label, whole.label * near.return_mask)
    assert torch.equal(near.reflectance, whole.reflectance * near.return_mask)


def test_scans_are_known_again_without_their_reflectance(folders, tmp_path):
    """As bare coordinates in .npy the same scans were not told to overlap before."""
    whole = open_source(str(folders / "fired"))
    for index in range(2):
        np.save(tmp_path / f"{index}.npy", whole.scans().scan(index).points_xyz_m.numpy())
    bare = open_source(str(tmp_path)).images(HDL64E)
    assert whole.images(HDL64E).provenance.overlap(bare.provenance) == "2 scans are in both"


def test_an_order_that_is_asked_for_is_not_replaced(folders):
    with pytest.raises(ScanError, match="not stored as they were fired"):
        open_source(str(folders / "shuffled")).images(HDL64E, DataConfig(projection="unfolding"))


def test_view_and_inspect_project_by_elevation_and_say_so(folders, capsys, heard):
    scans = str(folders / "shuffled")
    (seen,) = load_scan_sets([scans], 1)
    assert seen.images.return_mask.float().mean() > 0.5
    assert "hdl64e_kitti_odometry is taken" in heard[0]
    assert "not in firing order" in heard[1]
    assert cli.main(["inspect", scans]) == 0
    captured = capsys.readouterr()
    assert "not in firing order" in captured.err
    assert "spherical, exact" in captured.out
    assert "problem" not in captured.out


def test_rings_of_another_sensor_are_refused_with_the_cure():
    scan = replace(simulate(seed=0, sensor=load_sensor("vlp16").with_columns(360)), reflectance=None, label=None)
    x, y, z = scan.points_xyz_m.double().unbind(dim=1)
    rays = load_sensor("vlp16").elevation_rad[:, 0].double()
    scan = replace(scan, ring=(torch.atan2(z, torch.hypot(x, y))[:, None] - rays).abs().argmin(dim=1))
    with pytest.raises(
        ScanError,
        match=r"name the sensor that made the scan with --sensor \(vlp16, or find yours with .*fit-sensor",
    ):
        project(scan, HDL64E)
    assert "fewer lasers" in doubts_about_rays(scan, load_sensor("os1_64"), "spherical")
    assert "have fewer columns" in doubts_about_rays(scan, load_sensor("vlp16"), "spherical")
    upper_half = simulate(seed=0, sensor=load_sensor("vlp32c").with_columns(360))
    assert "fewer lasers" in doubts_about_rays(upper_half, HDL64E, "unfolding")
    assert not doubts_about_rays(scan, load_sensor("vlp16").with_columns(360), "spherical")


def test_settings_of_reading_scans_mean_the_same_by_word_and_by_option():
    word = ScanSettings.read(["data.projection=spherical", "data.sensor=vlp16", "data.columns=900"])
    option = ScanSettings.read([], projection="spherical", sensor="vlp16", columns=900)
    assert word == option
    assert word.load_sensor().width == 900
    assert word.load_sensor().projection == "spherical"
    assert ScanSettings.read().load_sensor() is None
    for word in ("data.nope=3", "data.train=x", "sensor=vlp16"):
        with pytest.raises(
            ConfigError, match=r"which reading scans does not have; wanted one such as data\."
        ) as refusal:
            ScanSettings.read([word])
        assert not re.search(r"data\.(train|val)|projection_variant,", refusal.value.wanted)
    assert ScanSettings.read([], projection_variant="reference").projection_variant == "reference"
    for words in (["projection=spherical"], ["data.train=x"], ["data.nothing=1"]):
        with pytest.raises(Exception, match="setting"):
            ScanSettings.read(words)
