"""The trees of scans: their splits, folders of mixed formats, and the real trees."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from dataset_examples import write_example
from format_examples import NAMES, can_write, written
from lidargrit.core.errors import DataError, ScanError, UnknownNameError
from lidargrit.core.files import write_json
from lidargrit.data import formats
from lidargrit.data.datasets import ScanDataset, load, open_dataset
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import load_range_images, open_source
from lidargrit.scans.projection import project
from lidargrit.scans.projection.unfolding import rings_from_firing_order
from lidargrit.scans.sensors import load_sensor
from lidargrit.simulator import simulate

ROWS = np.array([[1, 2, 3, 0.5], [4, 5, 6, 0.25], [7, 8, 9, 1]], dtype="<f4")


@pytest.fixture
def bin_file(tmp_path):
    """Return a function that writes rows or bytes and returns the path."""

    def write(content: np.ndarray | bytes, name: str = "000000.bin"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.astype("<f4").tobytes())
        return path

    return write


def with_cell(row: int, column: int | slice, value: float) -> np.ndarray:
    rows = ROWS.copy()
    rows[row, column] = value
    return rows


@pytest.mark.parametrize("sequences", ["sequences", "dataset/sequences"])
def test_kitti_odometry_splits(bin_file, tmp_path, sequences):
    for sequence in range(22):
        bin_file(ROWS, f"{sequences}/{sequence:02d}/velodyne/000000.bin")
    names = {
        split: set(names_of(open_dataset(f"kitti_odometry:{tmp_path}:{split}"))) for split in ("train", "val", "test")
    }
    assert names["val"] == {"08/000000"}
    assert names["test"] == {f"{sequence}/000000" for sequence in range(11, 22)}
    assert len(names["train"]) == 10
    assert set.union(*names.values()) == set(names_of(open_dataset(str(tmp_path))))
    assert names_of(open_dataset(f"{tmp_path}:03+00")) == ["00/000000", "03/000000"]
    assert len(open_dataset(f"{tmp_path}:train+val")) == 11
    with pytest.raises(DataError, match=r"'00\+3' .*'3' neither a split nor a sequence there; wanted one such as .*03"):
        open_dataset(f"{tmp_path}:00+3")


def test_kitti_360_val_is_in_train_but_not_in_train_without_val(bin_file, tmp_path):
    for drive in (0, 2, 3, 4, 5, 6, 7, 9, 10):
        bin_file(ROWS, f"data_3d_raw/2013_05_28_drive_{drive:04d}_sync/velodyne_points/data/0000000000.bin")
    parts = load("kitti_360").schemes["paper"].parts
    names = {part: set(names_of(open_dataset(f"kitti_360:{tmp_path}:{part}"))) for part in parts}
    assert names["test"] == {"0000/0000000000", "0002/0000000000"}
    assert names["train"] - names["train_without_val"] == names["val"] == {"0005/0000000000"}
    assert not names["train"] & names["test"]


def test_a_named_split_of_which_nothing_is_on_disk(bin_file, tmp_path):
    bin_file(ROWS, "sequences/00/velodyne/000000.bin")
    assert len(open_dataset(f"{tmp_path}:train")) == 1, "part of a split can be used"
    with pytest.raises(DataError, match=r"'val' .*, none of whose sequences is there; wanted .* 08; .* is there: 00"):
        open_dataset(f"{tmp_path}:val")


def test_a_root_of_another_layout_is_told_how_to_open_it(bin_file, tmp_path):
    bin_file(ROWS, "training/velodyne/000000.bin")
    with pytest.raises(DataError, match=f"it looks like kitti_object: open it as kitti_object:{tmp_path}"):
        open_dataset(f"kitti_360:{tmp_path}")


def test_a_share_of_a_folder_of_the_current_one(tmp_path, monkeypatch):
    write_example("folder", tmp_path / "scans", 4)
    monkeypatch.chdir(tmp_path)
    for source in ("scans[:50%]", "./scans[:50%]", "scans:all[:50%]", "folder:scans[:50%]"):
        assert len(open_dataset(source)) == 2


def test_sources_with_colons_brackets_and_places_that_do_not_exist(bin_file, tmp_path, monkeypatch):
    bin_file(ROWS, "a:b[:50%]/000000.bin")
    for source in ("folder:{}", "{}", "folder:{}:all", "{}:all[:100%]", "{}:."):
        assert names_of(open_dataset(source.format(tmp_path / "a:b[:50%]"))) == ["000000"]
    bin_file(ROWS, "at 12:30/drive/000000.bin")
    assert names_of(open_dataset(f"{tmp_path / 'at 12:30'}:drive")) == ["drive/000000"]
    monkeypatch.chdir(tmp_path)
    for split in ("drive", "drive[:100%]", "all[:100%]"):
        assert names_of(open_dataset(f"at 12:30:{split}")) == ["drive/000000"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="nowhere, which does not exist; wanted scans: a file, a folder or the root of"):
        open_dataset(str(tmp_path / "nowhere"))
    with pytest.raises(DataError, match="empty, which is an empty folder"):
        open_dataset(str(tmp_path / "empty"))
    bin_file(ROWS, "kitti_raw/000000.bin")
    assert names_of(open_dataset("kitti_raw")) == ["000000"], "a folder that is called as a data set is"


def test_links_to_folders_are_followed_once_and_not_around(bin_file, tmp_path):
    bin_file(ROWS, "disk/drive/000000.bin")
    bin_file(ROWS, "disk/drive/more/000001.bin")
    bin_file(ROWS, "mine/0.bin")
    for name, target in (("a", "disk/drive"), ("b", "disk/drive"), ("loop", "mine"), ("up", "."), ("sub/top", "mine")):
        (tmp_path / "mine" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "mine" / name).symlink_to(tmp_path / target)
    assert names_of(open_dataset(str(tmp_path / "mine"))) == ["0", "a/000000", "a/more/000001"]
    (tmp_path / "links").mkdir()
    (tmp_path / "links" / "drive").symlink_to(tmp_path / "disk" / "drive")
    assert names_of(open_dataset(str(tmp_path / "links"))) == ["drive/000000", "drive/more/000001"]
    (tmp_path / "disk" / "best").symlink_to(tmp_path / "disk" / "drive")  # sorts before what it links to
    assert names_of(open_dataset(str(tmp_path / "disk"))) == ["drive/000000", "drive/more/000001"]


@pytest.mark.parametrize("name", ["range_images", "nuscenes"])
def test_a_folder_of_one_format_with_more_below_is_read_whole(name, tmp_path):
    write_example(name, tmp_path / "tree", 2)
    first, second = sorted(path for path in (tmp_path / "tree").rglob("*") if path.is_file())
    (tmp_path / "mine" / "day2").mkdir(parents=True)
    first.rename(tmp_path / "mine" / first.name)
    assert open_dataset(str(tmp_path / "mine")).public_name() == name
    second.rename(tmp_path / "mine" / "day2" / second.name)
    assert len(open_dataset(str(tmp_path / "mine"))) == 2


def test_drives_that_may_not_be_read_are_not_passed_over(tmp_path, monkeypatch):
    write_example("kitti_odometry", tmp_path, 2)
    locked = tmp_path / "sequences" / "08"
    monkeypatch.setattr("os.access", lambda path, mode: Path(path) != locked)  # whoever runs the tests may read all
    with pytest.raises(DataError, match="sequences/08, which cannot be read"):
        open_dataset(f"kitti_odometry:{tmp_path}")


def test_the_wish_to_drop_points_reaches_the_reader(bin_file):
    folder = bin_file(with_cell(0, 0, np.nan)).parent
    with pytest.raises(ScanError, match="--bad-points drop"):
        open_dataset(str(folder)).scan(0)
    assert len(open_dataset(str(folder), bad_points="drop").scan(0)) == 2


def test_a_file_of_another_format_is_told_what_it_holds(bin_file):
    bin_file(ROWS, "0.bin")
    folder = bin_file(bytes(20), "sweep.bin").parent
    with pytest.raises(ScanError, match="5 columns, as nuScenes"):
        open_dataset(str(folder)).scan(1)


@pytest.fixture
def mixed(tmp_path):
    """Return a folder with a scan in every way in which we write them, one format below the other's folder."""
    for number, name in enumerate(one for one in NAMES if can_write(formats.load(one))):
        for suffix in formats.load(name).suffixes:
            folder = tmp_path / "mixed" / (name if number % 2 else "")
            folder.mkdir(parents=True, exist_ok=True)
            path = written(formats.load(name), folder, suffix)
            path.rename(path.with_name(f"{number}_{suffix.replace('.', '')}{suffix}"))
    (tmp_path / "mixed" / "README.txt").write_text("no scan")
    (tmp_path / "mixed" / ".hidden.bin").write_bytes(bytes(3))
    return tmp_path / "mixed"


def test_a_folder_of_all_formats_is_listed_and_read(mixed):
    dataset = open_dataset(f"folder:{mixed}")
    expected = [one.public_name() for one in map(formats.load, NAMES) if can_write(one) for _ in one.suffixes]
    assert len(dataset) == len(expected)
    got = [formats.recognise(dataset.path(index)).public_name() for index in range(len(dataset))]
    assert Counter(got) == Counter(expected)
    assert len(set(names_of(dataset))) == len(dataset)
    for index in range(len(dataset)):
        assert len(dataset.scan(index)) > 1000


def test_what_one_scan_lacks_no_batch_has(tmp_path):
    (tmp_path / "scans").mkdir()
    points = np.random.default_rng(0).uniform(-20, 20, (2000, 4)).astype(np.float32)
    points[:, 2:] = (points[:, 2:] + 20) / (-80, 40)
    for name, columns in (("a", 4), ("b", 3), ("c", 4)):
        np.save(tmp_path / "scans" / f"{name}.npy", points[:, :columns])
    config = DataConfig(workers=1, projection="spherical")
    mixed = load_range_images([str(tmp_path / "scans")], config)
    assert [mixed.batch([index]).reflectance for index in range(3)] == [None] * 3
    (tmp_path / "scans" / "b.npy").unlink()
    alike = load_range_images([str(tmp_path / "scans")], config)
    assert alike.batch([0, 1]).reflectance is not None


def test_one_bad_file_among_others_is_told_by_its_name_and_left_out(tmp_path, monkeypatch, heard):
    monkeypatch.setenv("LIDARGRIT_CACHE", str(tmp_path / "cache"))
    folder = tmp_path / "scans"
    folder.mkdir()
    for name in ("kitti_bin", "pcd", "ply", "numpy_array", "xyz_bin"):
        path = written(formats.load(name), folder)
        path.rename(folder / f"{name}{path.suffix}")
    good = (folder / "ply.ply").read_bytes()
    (folder / "bad.ply").write_bytes(good[: len(good) // 2])
    with pytest.raises(ScanError, match=r"bad\.ply.*--bad-scans skip"):
        load_range_images([str(folder)], DataConfig())
    images = load_range_images([str(folder)], DataConfig(bad_scans="skip"))
    assert len(images) == 5
    (left_out,) = [message for message in heard if message.startswith("left out: ")]
    assert str(folder / "bad.ply") in left_out
    lacking = f"WARNING: no reflectance in 1 of 5 scans, such as {folder / 'xyz_bin.bin'}, so that no scan is read with"
    assert any(message.startswith(lacking) for message in heard)


def test_simulated_splits_share_no_seed():
    first, last = (
        {s: open_dataset(f"simulated:1000000:{s}").name(i) for s in ("train", "val", "test")} for i in (0, -1)
    )
    assert list(first.values()) == ["seed_0000000", "seed_1000000", "seed_2000000"]
    assert list(last.values()) == ["seed_0999999", "seed_1999999", "seed_2999999"]
    assert names_of(open_dataset("simulated:10[90%:]")) == ["seed_0000009"]
    for count in ("0", "-1", "1e3", "1000001", "９" * 5000, "/data"):
        with pytest.raises(DataError, match=r"where a count belongs; wanted COUNT|a path of 15,000 bytes"):
            open_dataset(f"simulated:{count}")


def test_simulated_streets_are_scanned_by_the_sensor_behind_the_at_sign(tmp_path):
    file = tmp_path / "mine.json"
    write_json(file, load_sensor("vlp16").to_json())
    expected = simulate(seed=2_000_001, sensor=load_sensor("vlp16"))
    for sensor in ("vlp16", str(file)):
        streets = open_dataset(f"simulated:2@{sensor}:test")
        assert streets.sensor == sensor
        assert torch.equal(streets.scan(1).points_xyz_m, expected.points_xyz_m)
    assert open_dataset("simulated:2:test").sensor == "hdl64e_kitti_odometry"
    images = open_source("simulated:1@vlp16:test").images(config=DataConfig(columns=1800, column_stride=1))
    assert images.sensor.height == 16
    rings_with_returns = images.batch([0]).return_mask.any(2)
    assert rings_with_returns.float().mean() > 0.5
    source, vlp16 = open_source(f"simulated:1@{file}:test"), load_sensor("vlp16")
    before = source.images(vlp16).batch([0])
    write_json(
        file, replace(vlp16, elevation_rad=vlp16.elevation_rad / 2).to_json()
    )  # made anew, not found in the cache
    after = open_source(f"simulated:1@{file}:test").images(vlp16).batch([0])
    assert not torch.equal(before.return_mask, after.return_mask)
    with pytest.raises(UnknownNameError, match=r"'vlp15'.*vlp16"):
        open_dataset("simulated:2@vlp15")
    for wrong in ("2@", "@vlp16"):
        with pytest.raises(DataError, match=rf"'{wrong}' where a count belongs.*COUNT@SENSOR"):
            open_dataset(f"simulated:{wrong}")


def names_of(dataset: ScanDataset) -> list[str]:
    return [dataset.name(index) for index in range(len(dataset))]


REAL = {  # what is in the folder that does not travel with the project: sequences and how many scans of each
    "kitti_odometry": {"00": 20},
    "kitti_raw": {"2011_09_26_drive_9005_sync": 26, "2011_09_26_drive_9052_sync": 13},
    "kitti_object": {"training": 6, "testing": 6},
    "kitti_360": {"0000": 2},
    "folder": {".": 9},
    "range_images": {"muehlburger_tor": 171, "durlacher_tor": 26},
}
FOLDERS = {"folder": "folder_of_bins", "range_images": "karlsruhe_range_images"}


@pytest.fixture
def real_root(real):
    return lambda name: real / FOLDERS.get(name, name)


@pytest.mark.shared
@pytest.mark.parametrize("name", REAL)
def test_real_trees_are_recognised_and_complete(real_root, name):
    dataset = open_dataset(str(real_root(name)))
    assert dataset.public_name() == name
    assert Counter(scan.rpartition("/")[0] or "." for scan in names_of(dataset)) == REAL[name]
    for sequence, count in REAL[name].items():
        assert len(load(name)(real_root(name), sequence)) == count


@pytest.mark.shared
@pytest.mark.parametrize("name", [name for name in REAL if name != "range_images"])
def test_every_real_scan_has_64_rings_and_projects(real_root, name):
    dataset = open_dataset(f"{name}:{real_root(name)}")
    sensor = load_sensor(dataset.sensor)
    for index in range(len(dataset)):
        scan = dataset.scan(index)
        assert int(rings_from_firing_order(scan.points_xyz_m.numpy().T).max()) + 1 == 64, scan.source
        image = project(scan, sensor)
        assert image.return_mask.float().mean() > 0.6, scan.source
        assert image.reflectance is not None


@pytest.mark.shared
def test_every_real_range_image_projects_back_to_its_file(real_root):
    dataset = open_dataset(f"range_images:{real_root('range_images')}")
    sensor = load_sensor(dataset.sensor)
    as_stored = sensor.with_columns(870)
    for index in range(0, len(dataset), 7):
        scan = dataset.scan(index)
        with Image.open(dataset.path(index)) as image:
            stored_m = torch.from_numpy(np.array(image, dtype=np.float32) / 500)
        stored_m[(stored_m < sensor.range_min_m) | (stored_m > sensor.range_max_m)] = 0
        assert torch.allclose(project(scan, as_stored).range_m, stored_m, atol=1e-4), scan.source
        assert project(scan, sensor).return_mask.any()


def test_scans_without_leading_zeros_are_in_order_of_time(bin_file, tmp_path):
    for number in range(12):
        bin_file(ROWS, f"{number}.bin")
    names = [str(number) for number in range(12)]
    whole = open_dataset(str(tmp_path))
    assert [whole.name(index) for index in range(12)] == names
    late = open_dataset(f"{tmp_path}:all[75%:]")
    assert [late.name(index) for index in range(len(late))] == names[9:]


@pytest.mark.parametrize(
    ("split", "chosen"),
    [
        ("a+b", {"a+b"}),
        ("a+b+plain", {"a+b", "plain"}),
        ("plain+a+b[:50%]", {"a+b"}),
        ("a", {"a"}),
        ("run[1]", {"run[1]"}),
        ("run[1][50%:]", {"run[1]"}),
        ("x[:50%]", {"x[:50%]"}),
        ("*", {"*"}),
    ],
)
def test_sequences_may_have_any_name(bin_file, tmp_path, split, chosen):
    for name in ("a", "a+b", "plain", "run[1]", "x[:50%]", "*"):
        for number in range(2):
            bin_file(ROWS, f"{name}/{number}.bin")
    found = open_dataset(f"{tmp_path}:{split}")
    assert {found.name(index).rpartition("/")[0] for index in range(len(found))} == chosen
