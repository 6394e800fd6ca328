"""Prepared folders that are damaged, or made to do harm: each is refused in one line, or made anew."""

import json
import os
import resource
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest

from lidargrit.core.errors import DataError, OutputError, ScanError
from lidargrit.core.files import claim_folder
from lidargrit.data.datasets.kitti_odometry import KittiOdometry
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.prepared.prepare import damaged_shards, prepare
from lidargrit.data.prepared.prepared import PreparedImages
from lidargrit.data.prepared.shards import LocalBytes

prepare_module = sys.modules[prepare.__module__]
CONFIG = DataConfig(workers=1, columns=512, column_stride=8)


@pytest.fixture
def small_shards(monkeypatch):
    monkeypatch.setattr(prepare_module, "_SHARD_SCANS", 2)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return prepare("simulated:1", CONFIG, tmp_path_factory.mktemp("whole") / "out")


@pytest.fixture
def folder(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "out")


def pixels_of(folder):
    store = PreparedImages(str(folder))
    return [store.read(index) for index in range(len(store))]


@pytest.mark.parametrize("damage", [b"", b"noise" * 99])
def test_a_damaged_unfinished_shard_is_made_anew(folder, damage):
    (folder / "000000.shard").unlink()
    (folder / "000000.unfinished").write_bytes(damage)
    prepare("simulated:1", CONFIG, folder)
    assert len(PreparedImages(str(folder))) == 1
    assert damaged_shards(folder) == []
    assert not (folder / "000000.unfinished").exists()


def test_damage_is_found_and_made_good(tmp_path, small_shards):
    folder = prepare("simulated:6", CONFIG, tmp_path / "out")
    good = pixels_of(folder)
    second = folder / "000001.shard"
    content = bytearray(second.read_bytes())
    content[5000] ^= 255  # within the compressed pixels
    second.write_bytes(content)
    assert damaged_shards(folder) == [1]
    for damage in (b"", content[:-1], content[: len(content) // 2], b"noise" * 99):
        second.write_bytes(damage)
        with pytest.raises(DataError, match=r"000001.shard"):
            PreparedImages(str(folder))
        prepare("simulated:6", CONFIG, folder)
        assert all(np.array_equal(one[0], other[0]) for one, other in zip(pixels_of(folder), good, strict=True))
    shutil.copy(folder / "000000.shard", second)  # whole, but of other scans
    (folder / "scans.json").write_bytes(b"")
    prepare("simulated:6", CONFIG, folder)
    assert all(np.array_equal(one[0], other[0]) for one, other in zip(pixels_of(folder), good, strict=True))


@pytest.mark.parametrize(
    "change",
    [
        {"offset": -1},
        {"offset": 10**9},
        {"range_bytes": 10**12},
        {"range_bytes": "many"},
        {"scan": 77},
        {"scan": None},
        {"scan": False},
        {"offset": 8.0},
        {"fingerprint": [1]},
        {"reflectance_bytes": 3},
    ],
)
def test_an_index_that_lies_is_refused(folder, change):
    path = folder / "000000.shard"
    content = path.read_bytes()
    length = int.from_bytes(content[-16:-8], "little")
    index = json.loads(content[-16 - length : -16])
    index["entries"][0] |= change
    changed = json.dumps(index).encode()
    for lie in (changed, b"[" * 100_000, b"null", changed[:-1] + b', "x": 1e400}'):
        path.write_bytes(content[: -16 - length] + lie + len(lie).to_bytes(8, "little") + content[-8:])
        with pytest.raises(DataError, match="shard"):
            PreparedImages(str(folder)).read(0)


def test_a_blob_that_claims_to_be_gigabytes_is_refused_before_they_are_allocated(folder):
    path = folder / "000000.shard"
    content = bytearray(path.read_bytes())
    content[8 + 4 : 8 + 8] = (1 << 31).to_bytes(4, "little")  # the size in the header of the first blob
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"2147483648 bytes of pixels for an image of 65536"):
        PreparedImages(str(folder)).read(0)


@pytest.mark.parametrize("name", ["plan.json", "scans.json"])
@pytest.mark.parametrize(
    "content",
    ["null", "3", "[]", "[null]", "1e400", "[" * 40 + "]" * 40, '{"format": true}', "[[1, 2]]", "[" * 100_000, "{"],
)
def test_a_plan_or_a_list_of_scans_that_is_none_is_refused(folder, name, content):
    (folder / name).write_text(content)
    with pytest.raises(DataError, match=name):
        PreparedImages(str(folder))


@pytest.mark.parametrize("step_m", [0.0, 0.1, -0.002, 1e308])
def test_another_step_of_range_than_the_sensors_is_refused(folder, step_m):
    plan = json.loads((folder / "plan.json").read_text())
    (folder / "plan.json").write_text(json.dumps({**plan, "range_step_m": step_m}))
    with pytest.raises(DataError, match=r"range_step_m is another than its sensor's; wanted 0.002 m; prepare again"):
        PreparedImages(str(folder))


@pytest.mark.parametrize("name", ["plan.json", "scans.json", "000000.shard"])
def test_a_pipe_in_a_prepared_folder_does_not_hang(folder, name):
    (folder / name).unlink()
    os.mkfifo(folder / name)
    with pytest.raises(DataError, match=rf"{name}, which cannot be read \(not a file\)"):
        PreparedImages(str(folder))


def test_a_folder_goes_on_with_what_its_refusal_advised(tmp_path, small_shards):
    tree = tmp_path / "tree"
    KittiOdometry.write_example(tree, 5)
    KittiOdometry(tree).path(3).write_bytes(b"")
    config = DataConfig(workers=1)
    with pytest.raises(ScanError, match=r"--bad-scans skip"):
        prepare(str(tree), config, tmp_path / "out")
    made = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").glob("*.shard")}
    assert made
    assert len(PreparedImages(str(prepare(str(tree), replace(config, bad_scans="skip"), tmp_path / "out")))) == 4
    assert {path: path.stat().st_mtime_ns for path in made} == made
    with pytest.raises(OutputError, match="prepared with another bad_scans"):
        prepare(str(tree), config, tmp_path / "out")


def test_a_preparation_that_made_nothing_leaves_its_folder_free(tmp_path, monkeypatch):
    tree, out = tmp_path / "tree", tmp_path / "out"
    KittiOdometry.write_example(tree, 2)
    good = KittiOdometry(tree).path(0).read_bytes()
    KittiOdometry(tree).path(0).write_bytes(good[:-3])
    with pytest.raises(ScanError, match="download it again"):
        prepare(str(tree), CONFIG, out)
    assert not list(out.iterdir())
    with claim_folder(out, shared=True), pytest.raises(ScanError):  # as another machine does that works by the plan
        prepare(str(tree), CONFIG, out)
    assert {path.name for path in out.iterdir()} == {"plan.json", "scans.json"}

    failed = []

    def once_another_failed(folder, shared=False):  # between this machine's plan and its lock
        if not failed:
            failed.append(folder)
            prepare_module._take_back(folder)
            assert not (folder / "plan.json").exists()
        return claim_folder(folder, shared)

    KittiOdometry(tree).path(0).write_bytes(good)
    shutil.rmtree(out)
    monkeypatch.setattr(prepare_module, "claim_folder", once_another_failed)
    assert len(PreparedImages(str(prepare(str(tree), CONFIG, out)))) == 2


def test_scans_that_were_left_out_do_not_come_back_unseen(tmp_path, small_shards):
    tree, out = tmp_path / "tree", tmp_path / "out"
    KittiOdometry.write_example(tree, 4)
    path = KittiOdometry(tree).path(2)
    points = np.fromfile(path, "<f4")
    points[:3] = 0
    points.tofile(path)
    skip = DataConfig(workers=1, bad_scans="skip")
    assert len(PreparedImages(str(prepare(str(tree), skip, out)))) == 3
    drop = replace(skip, bad_points="drop")
    with pytest.raises(OutputError, match="stale: prepared with another bad_points"):
        prepare(str(tree), drop, out)
    assert len(PreparedImages(str(prepare(str(tree), drop, tmp_path / "anew")))) == 4


def test_a_link_to_nothing_is_left_out_where_bad_scans_are(tmp_path):
    tree = tmp_path / "tree"
    KittiOdometry.write_example(tree, 2)
    path = KittiOdometry(tree).path(0)
    (path.parent / "000007.bin").symlink_to(tmp_path / "nothing.bin")
    with pytest.raises(DataError, match=r"000007\.bin, which cannot be read"):
        prepare(str(tree), DataConfig(workers=1), tmp_path / "out")
    images = PreparedImages(str(prepare(str(tree), DataConfig(workers=1, bad_scans="skip"), tmp_path / "out")))
    assert len(images) == 2
    assert len(images.left_out) == 1


def test_a_machine_verifies_its_own_shards_alone(tmp_path, small_shards):
    """Another one may be making a damaged shard again, which must not be taken for damaged and removed."""
    folder = prepare("simulated:6", CONFIG, tmp_path / "out")
    second = folder / "000001.shard"
    content = bytearray(second.read_bytes())
    content[5000] ^= 255
    second.write_bytes(content)
    assert damaged_shards(folder, rank=0, world_size=2) == []
    assert damaged_shards(folder, rank=1, world_size=2) == [1]


def test_more_shards_than_a_process_may_open_are_opened_all_the_same(tmp_path):
    (tmp_path / "shard").write_bytes(b"bytes")
    allowed, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(128, allowed), most))
        kept = [LocalBytes(tmp_path / "shard") for _ in range(150)]
        assert bytes(kept[-1].read(1, 3)) == b"yt"
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, most))
