"""Prepared folders that are damaged, or made to do harm: each is refused in one line, or made anew."""

import json
import os
import resource
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from google_crc32c import value as crc32c

from dataset_examples import write_example
from lidargrit.core.errors import DataError, OutputError, ScanError
from lidargrit.core.files import claim_folder
from lidargrit.data.datasets.kitti_odometry import KittiOdometry
from lidargrit.data.prepared.arrays import ImageArrays
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.prepared.plan import made_name, pixels_name
from lidargrit.data.prepared.prepare import damaged_shards, prepare
from lidargrit.data.prepared.prepared import PreparedImages
from lidargrit.data.prepared.workers import ShardWriter
from lidargrit.scans.types import RangeImage

prepare_module = sys.modules[prepare.__module__]
MADE, RANGES = made_name(0), pixels_name("range", 0)
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
def test_a_shard_whose_facts_are_damaged_is_made_anew(folder, damage):
    good = pixels_of(folder)
    (folder / MADE).write_bytes(damage)
    (folder / RANGES).write_bytes(damage)
    prepare("simulated:1", CONFIG, folder)
    assert np.array_equal(pixels_of(folder)[0].range_m, good[0].range_m)
    assert damaged_shards(folder) == []


def test_damage_is_found_and_made_good(tmp_path, small_shards):
    folder = prepare("simulated:6", CONFIG, tmp_path / "out")
    good = pixels_of(folder)
    second = folder / pixels_name("range", 1)
    content = bytearray(second.read_bytes())
    content[5000] ^= 255  # within the compressed pixels
    second.write_bytes(content)
    assert damaged_shards(folder) == [1]
    for damage in (b"", content[:-1], content[: len(content) // 2], b"noise" * 99, None):
        second.unlink() if damage is None else second.write_bytes(damage)
        with pytest.raises(DataError, match=r"images.zarr, damaged .*; prepare it again with --verify"):
            pixels_of(folder)
        prepare("simulated:6", CONFIG, folder)
        assert all(np.array_equal(one[0], other[0]) for one, other in zip(pixels_of(folder), good, strict=True))
    shutil.copy(folder / made_name(0), folder / made_name(1))  # whole, but of other scans
    (folder / "scans.json").write_bytes(b"")
    prepare("simulated:6", CONFIG, folder)
    assert all(np.array_equal(one[0], other[0]) for one, other in zip(pixels_of(folder), good, strict=True))


def test_a_pixel_that_changed_within_its_checksum_is_found_by_its_fingerprint(folder):
    spec = PreparedImages(str(folder)).spec
    steps = np.full((1, 64, 512), 7, np.uint16)
    ImageArrays(str(folder), spec).write(0, {"range": steps})
    images = PreparedImages(str(folder))
    assert np.all(images.read(0).range_m == np.float32(7 * spec.range_step_m))
    with pytest.raises(DataError, match="pixels of scan 0 that differ from their fingerprint"):
        images.read(0, verify=True)


@pytest.mark.parametrize("plane", ["range", "reflectance", "label"])
def test_what_is_not_there_is_never_taken_for_zeros(folder, plane):
    (folder / pixels_name(plane, 0)).unlink()
    with pytest.raises(DataError, match="differ from their fingerprint"):
        PreparedImages(str(folder)).read(0)


def test_a_scan_without_a_return_is_none_that_is_lost(tmp_path):
    spec = prepare("simulated:1", CONFIG, tmp_path / "out")
    writer = ShardWriter(tmp_path / "other", PreparedImages(str(spec)).spec, 0)
    shape = 64, 512
    writer.add(
        0, RangeImage.masked(torch.ones(shape), torch.zeros(shape, dtype=torch.bool), CONFIG.load_sensor().fine())
    )
    writer.keep()
    for name in ("plan.json", "scans.json"):
        shutil.copy(tmp_path / "out" / name, tmp_path / "other" / name)
    assert not PreparedImages(str(tmp_path / "other")).read(0, verify=True).range_m.any()
    assert (tmp_path / "other" / RANGES).is_file()


@pytest.mark.parametrize(
    "change",
    [
        {"scan": 77},
        {"scan": None},
        {"scan": False},
        {"full_scale": 8.0},
        {"full_scale": -1},
        {"fingerprint": [1]},
        {"range_fingerprint": None},
        {"offset": 3},
    ],
)
def test_facts_that_lie_are_refused(folder, change):
    facts = json.loads((folder / MADE).read_text())
    facts["images"][0] |= change
    changed = json.dumps(facts).encode()
    for lie in (changed, b"[" * 100_000, b"null", changed[:-1] + b', "x": 1e400}'):
        (folder / MADE).write_bytes(lie)
        with pytest.raises(DataError, match=r"made/000000\.json"):
            PreparedImages(str(folder))


def test_an_array_of_another_shape_is_refused_before_it_is_read(folder):
    path = folder / "images.zarr" / "range" / "zarr.json"
    about = json.loads(path.read_text())
    for change in ({"shape": [1, 64, 10**9]}, {"data_type": "float64"}, {"codecs": about["codecs"] * 2}):
        path.write_text(json.dumps(about | change))
        with pytest.raises(DataError, match=r"images\.zarr, damaged"):
            PreparedImages(str(folder)).read(0)


def test_a_blob_that_claims_to_be_gigabytes_is_refused_before_they_are_allocated(folder):
    path = folder / RANGES
    content = bytearray(path.read_bytes())
    index = content[-(128 * 16 + 4) : -4]
    start, length = (int.from_bytes(index[at : at + 8], "little") for at in (0, 8))
    blob = content[start : start + length - 4]
    blob[4:8] = (2**31 - 256).to_bytes(4, "little")  # the size of the pixels
    content[start : start + length] = blob + crc32c(bytes(blob)).to_bytes(4, "little")
    path.write_bytes(content)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(DataError, match=r"images\.zarr, damaged"):
        PreparedImages(str(folder)).read(0)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**20, "in KiB"


@pytest.mark.parametrize("name", ["plan.json", "scans.json"])
@pytest.mark.parametrize(
    "content",
    ["null", "3", "[]", "[null]", "1e400", "[" * 40 + "]" * 40, '{"format": true}', "[[1, 2]]", "[" * 100_000, "{"],
)
def test_a_plan_or_a_list_of_scans_that_is_none_is_refused(folder, name, content):
    (folder / name).write_text(content)
    with pytest.raises(DataError, match=name):
        PreparedImages(str(folder))


@pytest.mark.parametrize(("more", "told"), [({}, "lacks 'bad_points', 'bad_scans', 'digest'"), ({"a": 1}, "has 'a'")])
def test_what_a_plan_lacks_or_has_besides_is_told(folder, more, told):
    plan = json.loads((folder / "plan.json").read_text()) if more else {}
    (folder / "plan.json").write_text(json.dumps({**plan, **more}))
    with pytest.raises(DataError, match=rf"plan.json, which is no plan \(it {told}\); wanted"):
        PreparedImages(str(folder))


@pytest.mark.parametrize("step_m", [0.0, 0.1, -0.002, 1e308])
def test_another_step_of_range_than_the_sensors_is_refused(folder, step_m):
    plan = json.loads((folder / "plan.json").read_text())
    (folder / "plan.json").write_text(json.dumps({**plan, "range_step_m": step_m}))
    with pytest.raises(DataError, match=r"range_step_m is another than its sensor's; wanted 0.002 m; prepare again"):
        PreparedImages(str(folder))


@pytest.mark.parametrize("name", ["plan.json", "scans.json", MADE])
def test_a_pipe_in_a_prepared_folder_does_not_hang(folder, name):
    (folder / name).unlink()
    os.mkfifo(folder / name)
    with pytest.raises(DataError, match=rf"{name}, which cannot be read \(not a file\)"):
        PreparedImages(str(folder))


@pytest.mark.parametrize("name", [RANGES, "images.zarr/range/zarr.json"])
def test_a_pipe_among_the_pixels_does_not_hang(folder, name):
    (folder / name).unlink()
    os.mkfifo(folder / name)
    arrays, wanted = ImageArrays(str(folder), PreparedImages(str(folder)).spec), np.zeros((1, 64, 4096), np.uint16)
    for use in (lambda: pixels_of(folder), lambda: arrays.write(0, {"range": wanted})):
        with pytest.raises(DataError, match=f"^got {folder / name}, a named pipe; wanted what lidargrit prepare wrote"):
            use()


def test_a_sensor_that_is_none_is_told_with_its_file(folder):
    plan = json.loads((folder / "plan.json").read_text())
    plan["sensor"]["range_max_m"] = -1
    (folder / "plan.json").write_text(json.dumps(plan))
    with pytest.raises(DataError, match=r"plan\.json, in which stands range limits .* to -1 m"):
        PreparedImages(str(folder))


def test_a_folder_goes_on_with_what_its_refusal_advised(tmp_path, small_shards):
    tree = tmp_path / "tree"
    write_example("kitti_odometry", tree, 5)
    KittiOdometry(tree).path(3).write_bytes(b"")
    config = DataConfig(workers=1)
    with pytest.raises(ScanError, match=r"--bad-scans skip"):
        prepare(str(tree), config, tmp_path / "out")
    made = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").glob("images.zarr/*/c.*")}
    assert made
    assert len(PreparedImages(str(prepare(str(tree), replace(config, bad_scans="skip"), tmp_path / "out")))) == 4
    assert {path: path.stat().st_mtime_ns for path in made} == made
    with pytest.raises(OutputError, match="prepared with another bad_scans"):
        prepare(str(tree), config, tmp_path / "out")


def test_a_preparation_that_made_nothing_leaves_its_folder_free(tmp_path, monkeypatch):
    tree, out = tmp_path / "tree", tmp_path / "out"
    write_example("kitti_odometry", tree, 2)
    good = KittiOdometry(tree).path(0).read_bytes()
    KittiOdometry(tree).path(0).write_bytes(good[:-3])
    with pytest.raises(ScanError, match="download it again"):
        prepare(str(tree), CONFIG, out)
    assert not list(out.iterdir())
    with claim_folder(out, shared=True), pytest.raises(ScanError):  # as another machine does that works by the plan
        prepare(str(tree), CONFIG, out)
    assert {path.name for path in out.iterdir()} == {"plan.json", "scans.json", "made"}

    failed = []

    def once_another_failed(folder, shared=False):  # between this machine's plan and its lock
        if not failed and (folder / "plan.json").exists():
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
    write_example("kitti_odometry", tree, 4)
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
    write_example("kitti_odometry", tree, 2)
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
    second = folder / pixels_name("range", 1)
    content = bytearray(second.read_bytes())
    content[5000] ^= 255
    second.write_bytes(content)
    assert damaged_shards(folder, rank=0, world_size=2) == []
    assert damaged_shards(folder, rank=1, world_size=2) == [1]
