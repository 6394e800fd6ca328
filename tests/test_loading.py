"""The cache of projected scans: same pixels as projecting, found again, never stale, never half."""

import numpy as np
import pytest
import torch

from lidargrit import loading
from lidargrit.datasets.kitti_odometry import KittiOdometry
from lidargrit.errors import DataError, ScanError
from lidargrit.loading import DataConfig, load_range_images
from lidargrit.projection import project
from lidargrit.reporting import Reporter


class Listener(Reporter):
    def __init__(self):
        self.lines = []

    def message(self, text):
        self.lines.append(text)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("LIDARGRIT_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def tree(tmp_path):
    KittiOdometry.write_example(tmp_path / "tree", 5)
    return tmp_path / "tree"


def load(tree, **settings):
    config = DataConfig(train=(str(tree),), val=(), **settings)
    return load_range_images(config.train, config), config


def test_cached_pixels_are_those_of_projecting(tree):
    images, config = load(tree)
    dataset = KittiOdometry(tree)
    assert len(images) == len(dataset) == 5
    direct = [project(dataset.scan(index), config.load_sensor()).range_m for index in range(5)]
    assert torch.equal(images.batch(range(5)).range_m, torch.stack(direct))
    shifted = images.batch([2], [3]).range_m[0]
    assert torch.equal(shifted, project(dataset.scan(2), config.load_sensor().fine()).range_m[:, 3::8])


def test_the_cache_is_used_and_knows_when_it_is_stale(tree, monkeypatch):
    load(tree)

    def must_not(*arguments, **settings):
        raise AssertionError("projected again")

    with monkeypatch.context() as patch:
        patch.setattr(loading, "project", must_not)
        load(tree)
    changed = KittiOdometry(tree).paths[0]
    rows = np.fromfile(changed, dtype="<f4").reshape(-1, 4)
    rows[:, :3] *= 0.5
    before = load(tree)[0].batch([0]).range_m
    rows.tofile(changed)
    assert not torch.equal(load(tree)[0].batch([0]).range_m, before)


def test_a_failed_projection_leaves_no_cache_behind(tree, cache):
    KittiOdometry(tree).paths[3].write_bytes(b"")
    with pytest.raises(ScanError, match=r"leave such scans out by --set data.bad_scans=skip"):
        load(tree)
    assert not [path for path in cache.iterdir() if path.suffix in (".npy", ".json")]
    images, _ = load(tree, bad_scans="skip")
    assert len(images) == 4
    assert not any(str(KittiOdometry(tree).paths[3]) in name for name in images.names)


def test_max_scans_are_spread_evenly(tree):
    images, _ = load(tree, max_scans=2)
    assert [name[-10:] for name in images.names] == ["000000.bin", KittiOdometry(tree).paths[2].name]


def test_a_sensor_of_another_data_set_is_warned_of(tree):
    listener = Listener()
    config = DataConfig(train=(str(tree),), val=(), sensor="hdl64e_kitti_360")
    load_range_images(config.train, config, listener)
    assert any("WARNING" in line and "imaged as hdl64e_kitti_360" in line for line in listener.lines)
    with pytest.raises(DataError, match="no source of scans"):
        load_range_images((), config)
