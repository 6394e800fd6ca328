"""Prepared range images: pixels of projecting, found again, never stale, never half, whoever made which part."""

import json
import os
import shutil
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dataset_examples import write_example
from lidargrit.core.errors import ConfigError, DataError, OutputError, ScanError
from lidargrit.data.batches import Batches
from lidargrit.data.datasets import open_dataset
from lidargrit.data.datasets.kitti_odometry import KittiOdometry
from lidargrit.data.images import Provenance, RangeImages
from lidargrit.data.prepared import workers
from lidargrit.data.prepared.arrays import range_step_m
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.prepared.prepare import damaged_shards, prepare
from lidargrit.data.prepared.prepare import prepare as prepare_function
from lidargrit.data.prepared.prepared import PreparedImages
from lidargrit.data.sources import load_range_images
from lidargrit.scans.projection import project
from lidargrit.scans.sensors import load_sensor

prepare_module = sys.modules[prepare_function.__module__]
SIMULATED = DataConfig(workers=1)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("LIDARGRIT_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(scope="module")
def whole_tree(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "tree"
    write_example("kitti_odometry", folder, 5)
    return folder


@pytest.fixture
def tree(whole_tree, tmp_path):
    """Return a copy of five scans, to be damaged."""
    return shutil.copytree(whole_tree, tmp_path / "tree")


@pytest.fixture
def small_shards(monkeypatch):
    monkeypatch.setattr(prepare_module, "_SHARD_SCANS", 2)


def load(tree, **settings):
    config = DataConfig(train=(str(tree),), val=(), **settings)
    return load_range_images(config.train, config), config


def pixels_of(folder):
    store = PreparedImages(str(folder))
    return [store.read(index) for index in range(len(store))]


def same(one, other):
    """Tell whether two prepared folders hold the same; blocks may be compressed in another order."""
    assert damaged_shards(one) == damaged_shards(other) == []
    stores = [PreparedImages(str(folder)) for folder in (one, other)]
    return stores[0].provenance == stores[1].provenance


def test_prepared_pixels_are_those_of_projecting_to_a_millimetre(tree):
    images, config = load(tree)
    dataset = KittiOdometry(tree)
    assert len(images) == len(dataset) == 5
    direct = [project(dataset.scan(index), config.load_sensor()) for index in range(5)]
    batch = images.batch(range(5))
    assert torch.equal(batch.return_mask, torch.stack([image.return_mask for image in direct]))
    assert (batch.range_m - torch.stack([image.range_m for image in direct])).abs().max() <= 0.00101
    assert batch.reflectance is not None
    expected = torch.stack([image.reflectance for image in direct if image.reflectance is not None])
    assert (batch.reflectance - expected).abs().max() <= 0.5 / 255 + 1e-6
    fine = project(dataset.scan(2), config.load_sensor().fine())
    assert (images.batch([2], [3]).range_m[0] - fine.range_m[:, 3::8]).abs().max() <= 0.00101


@pytest.mark.parametrize(("reach_m", "step_m"), [(80.0, 0.002), (131.0, 0.002), (131.1, 0.004), (300.0, 0.006)])
def test_steps_are_2_mm_as_far_as_16_bits_reach(reach_m, step_m):

    sensor = replace(load_sensor("hdl64e_kitti_360"), range_max_m=reach_m)
    assert range_step_m(sensor) == pytest.approx(step_m)
    assert reach_m / range_step_m(sensor) <= 65535


def test_an_image_takes_at_most_160_kilobytes(real):
    images = load_range_images(
        (f"kitti_odometry:{real / 'kitti_odometry'}",),
        DataConfig(sensor="hdl64e_kitti_360", projection="spherical", max_scans=4),
    )
    store = images._stores[0]
    assert isinstance(store, PreparedImages)
    size = sum(path.stat().st_size for path in Path(store._folder.location, "images.zarr").glob("*/c.*"))
    assert 0 < size / 4 < 160_000


def test_the_cache_is_used_and_knows_when_it_is_stale(tree, monkeypatch):
    load(tree)

    def must_not(*arguments, **settings):
        raise AssertionError("projected again")

    with monkeypatch.context() as patch:
        patch.setattr(workers, "project", must_not)
        load(tree)
        with pytest.raises(AssertionError, match="projected again"):
            load(tree, columns=1024)
    changed = KittiOdometry(tree).path(0)
    rows = np.fromfile(changed, dtype="<f4").reshape(-1, 4)
    rows[:, :3] *= 0.5
    before = load(tree)[0].batch([0]).range_m
    rows.tofile(changed)
    assert not torch.equal(load(tree)[0].batch([0]).range_m, before)


def test_a_folder_prepared_from_what_has_changed_is_called_stale(tree, tmp_path):
    config = DataConfig()
    folder = prepare(str(tree), config, tmp_path / "out")
    assert prepare(str(tree), config, folder) == folder, "again: nothing to do"
    os.utime(KittiOdometry(tree).path(0))
    with pytest.raises(OutputError, match=r"which is stale: prepared with other scans"):
        prepare(str(tree), config, folder)
    with pytest.raises(OutputError, match="which is stale: prepared with another sensor"):
        prepare("simulated:1", DataConfig(columns=512), prepare("simulated:1", config, tmp_path / "other"))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(OutputError, match="holds something else"):
        prepare(str(tree), config, tmp_path / "mine")


def test_a_failed_projection_leaves_nothing_that_looks_whole(tree, cache, heard):
    bad = KittiOdometry(tree).path(3)
    bad.write_bytes(b"")
    with pytest.raises(ScanError, match=r"leave such scans out by --bad-scans skip"):
        load(tree)
    assert not list(cache.rglob("c.*"))
    config = DataConfig(bad_scans="skip")
    images = load_range_images((str(tree),), config)
    assert len(images) == 4
    assert str(bad) not in images.provenance.names
    assert [line for line in heard if "left out" in line and str(bad) in line]


def test_max_scans_are_spread_evenly(tree):
    images, _ = load(tree, max_scans=2)
    assert [name[-10:] for name in images.provenance.names] == ["000000.bin", KittiOdometry(tree).path(2).name]


def test_a_sensor_with_fewer_lasers_than_the_scans_show_is_warned_of(tree, heard):
    config = DataConfig(train=(str(tree),), val=(), sensor="hdl32e", projection="spherical", max_scans=1)
    load_range_images(config.train, config)
    (warning,) = (line for line in heard if "WARNING" in line)
    assert "imaged as hdl32e" in warning
    assert "points of two lasers" in warning
    assert "lidargrit fit-sensor" in warning
    with pytest.raises(DataError, match="no source of scans"):
        load_range_images((), config)


def test_processes_make_the_same_shards_and_count_every_scan(tree, tmp_path, small_shards):
    alone = prepare(str(tree), SIMULATED, tmp_path / "alone")
    together = prepare(str(tree), DataConfig(workers=2), tmp_path / "together")
    names, theirs = (sorted(path.name for path in folder.glob("images.zarr/range/c.*")) for folder in (alone, together))
    assert len(names) == 3, "of which one process makes two"
    assert names == theirs
    assert same(alone, together)


def test_machines_share_the_work_and_wait_for_one_another(tree, tmp_path, small_shards):
    def machine(rank: int) -> None:
        prepare(str(tree), SIMULATED, tmp_path / "shared_disk", rank=rank, world_size=2)

    threads = [threading.Thread(target=machine, args=(rank,)) for rank in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    ours, alone = (pixels_of(folder) for folder in (tmp_path / "shared_disk", prepare(str(tree), SIMULATED)))
    assert all(np.array_equal(one[0], other[0]) for one, other in zip(ours, alone, strict=True))
    with pytest.raises(ConfigError, match="rank 2 of 2"):
        prepare(str(tree), SIMULATED, rank=2, world_size=2)


def test_a_bad_scan_met_by_another_process_is_told_here(tree, small_shards):
    np.full((8, 4), np.nan, np.float32).tofile(KittiOdometry(tree).path(4))  # only reading finds it, in its process
    with pytest.raises(ScanError, match=r"8 of 8 points with NaN .*--bad-scans skip") as told:
        load(tree, workers=2)
    assert "_made_by_processes" in [entry.name for entry in told.traceback]


KILLED_AND_FINISHED = """
import os, signal, sys, time
from pathlib import Path
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.prepared.prepare import prepare
folder = Path(sys.argv[1])
sys.modules[prepare.__module__]._SHARD_SCANS = 2

def begun():
    if child := os.fork():
        return child
    try:
        prepare("simulated:8@vlp16", DataConfig(sensor="vlp16", workers=1), folder)
        os._exit(0)
    finally:
        os._exit(1)

killed = 0
for delay_s in (0.1, 0.4, 0.7):
    child, until = begun(), time.monotonic() + 30
    while time.monotonic() < until and not (folder / "plan.json").exists():
        time.sleep(0.01)
    time.sleep(delay_s)
    os.kill(child, signal.SIGKILL)
    killed += os.waitpid(child, 0)[1] == signal.SIGKILL
sys.exit(os.waitpid(begun(), 0)[1] != 0 or not killed)
"""


def test_killed_at_any_moment_it_goes_on_and_ends_the_same(tmp_path, small_shards):
    subprocess.run([sys.executable, "-c", KILLED_AND_FINISHED, str(tmp_path / "killed")], check=True)
    prepare("simulated:8@vlp16", replace(SIMULATED, sensor="vlp16"), tmp_path / "whole")
    assert len(list((tmp_path / "whole").glob("images.zarr/range/c.*"))) == 4
    names = [sorted(str(path.relative_to(folder)) for path in folder.rglob("*")) for folder in tmp_path.iterdir()]
    assert names[0] == names[1], "nothing half-written is left"
    assert same(tmp_path / "killed", tmp_path / "whole")


class StopsAfter:
    """Projects some scans, and then is interrupted; tells how many it was asked for."""

    def __init__(self, count):
        self.count, self.asked = count, 0

    def __call__(self, *arguments, **settings):
        if self.asked == self.count:
            raise KeyboardInterrupt
        self.asked += 1
        return project(*arguments, **settings)


def test_a_shard_is_taken_up_where_a_process_was_stopped(tree, tmp_path, monkeypatch):
    monkeypatch.setattr(workers, "_KEEP_EVERY_S", -1.0)  # after every scan
    folder = tmp_path / "stopped"
    monkeypatch.setattr(workers, "project", StopsAfter(3))
    with pytest.raises(KeyboardInterrupt):
        prepare(str(tree), SIMULATED, folder)
    assert len(json.loads((folder / "made" / "000000.json").read_text())["images"]) == 3
    monkeypatch.setattr(workers, "project", rest := StopsAfter(5))
    prepare(str(tree), SIMULATED, folder)
    assert rest.asked == 2, "only the scans that were not done"
    monkeypatch.setattr(workers, "project", project)
    assert same(folder, prepare(str(tree), SIMULATED, tmp_path / "whole"))
    assert sorted(path.name for path in folder.iterdir()) == ["images.zarr", "made", "plan.json", "scans.json"]
    assert [path.name for path in (folder / "made").iterdir()] == ["000000.json"]


def test_images_of_more_columns_serve_fewer_as_a_projection_would(tree, tmp_path):
    def set_of(source, columns, stride=1, **settings):
        config = DataConfig(columns=columns, column_stride=stride, workers=1, **settings)
        return load_range_images((str(source),), config)

    wide = prepare(str(tree), DataConfig(workers=1), tmp_path / "wide")  # 2048 columns, of which images keep 256
    for columns, stride in ((512, 1), (512, 2), (256, 1)):
        gathered, projected = set_of(wide, columns, stride), set_of(tree, columns, stride)
        one, other = gathered.batch([0, 4], [stride - 1] * 2), projected.batch([0, 4], [stride - 1] * 2)
        assert one.range_m.shape == (2, 64, columns // stride)
        assert torch.equal(one.range_m, other.range_m)
        assert one.reflectance is not None
        assert other.reflectance is not None
        is_same = (one.reflectance - other.reflectance).abs() < 1e-6
        assert is_same.float().mean() > 0.96, "two returns may lie within one step of 2 mm"
    assert gathered.provenance.names == projected.provenance.names
    odd, exact = set_of(wide, 360).batch([0]), set_of(tree, 360).batch([0])
    assert (odd.return_mask == exact.return_mask).float().mean() > 0.9
    with pytest.raises(DataError, match="prepared for"):
        set_of(wide, 4096)
    rounded = prepare(str(tree), DataConfig(workers=1, projection_variant="reference"), tmp_path / "rounded")
    with pytest.raises(DataError, match="prepared for"):
        set_of(rounded, 512, projection_variant="reference")


def test_batches_come_in_one_order_whatever_reads_them(tree):
    images, _ = load(tree)

    def stream(workers_count, first=0, **process):
        batches = Batches(images, 4, ("flip", "roll"), True, 3, workers=workers_count, **process)
        return [batch.images.range_m for batch in batches.stream(first, 24)]

    alone = stream(1)
    assert len(alone) == 6
    assert all(torch.equal(one, other) for one, other in zip(alone, stream(4), strict=True))
    assert all(torch.equal(one, other) for one, other in zip(alone[2:], stream(3, first=8), strict=True))
    shares = zip(stream(2, rank=0, world_size=2), stream(1, rank=1, world_size=2), strict=True)
    ordered = Batches(images, 4, (), False, 3)
    whole = [ordered.at(seen).images.range_m for seen in range(0, 24, 4)]
    plain = [Batches(images, 4, (), False, 3, rank, 2) for rank in (0, 1)]
    for seen, both in zip(range(0, 24, 4), whole, strict=True):
        assert torch.equal(torch.cat([batches.at(seen).images.range_m for batches in plain]), both)
    assert all(len(one) == len(other) == 2 for one, other in shares)


def test_an_error_while_reading_ahead_reaches_the_reader():
    class Broken:
        provenance = Provenance()

        def __len__(self):
            return 2

        def read(self, index):
            raise ScanError("a broken file", "a whole one", "mend it")

    broken = Batches(RangeImages(load_sensor("vlp16"), [Broken()]), 2, (), False, 0, workers=2)
    with pytest.raises(ScanError, match="a broken file"):
        list(broken.stream(0, 8))


def overlap_of(one, other):
    return one.provenance.overlap(other.provenance)


def test_overlap_is_told_by_file_by_pixels_and_by_drive(tree, tmp_path):
    everything, first, last = (load_range_images((f"{tree}:{split}",), SIMULATED) for split in ("all", "00", "08"))
    assert overlap_of(everything, first) == "3 scans are in both"
    assert overlap_of(first, last) == ""
    copied = tmp_path / "copied.bin"
    copied.write_bytes(KittiOdometry(tree).path(0).read_bytes())
    assert overlap_of(load_range_images((str(copied),), SIMULATED), first) == "1 scan is in both"
    halves = [load_range_images((f"{tree}:00{share}",), SIMULATED) for share in ("[:50%]", "[50%:]")]
    assert overlap_of(*halves) == f"both have scans of {open_dataset(f'{tree}:00').recording(0)}"
    assert overlap_of(*(load_range_images((f"simulated:1:{split}",), SIMULATED) for split in ("train", "val"))) == ""
