"""The readers of scans: what they refuse, their splits, and the real trees."""

import os
from collections import Counter

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from lidargrit.datasets import ScanDataset, load, open_dataset
from lidargrit.datasets._files import read_bin
from lidargrit.errors import DataError, OutputError, ScanError
from lidargrit.projection import project
from lidargrit.projection.unfolding import rings_from_firing_order
from lidargrit.sensors import load_sensor
from lidargrit.structures import Scan

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


def test_read_bin_keeps_rows_and_their_order(bin_file):
    path = bin_file(ROWS)
    scan = read_bin(str(path))
    assert np.array_equal(scan.points_xyz_m.numpy(), ROWS[:, :3])
    assert scan.reflectance is not None
    assert np.array_equal(scan.reflectance.numpy(), ROWS[:, 3])
    assert (scan.ring, scan.source) == (None, str(path))


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"", "got an empty file, .*; wanted float32 rows x, y, z, reflectance, 16 bytes a point; download it again"),
        (bytes(33), "got 33 bytes in .*, 1 more than whole points; .*; download it again: the file was cut short"),
        (bytes(36), "got 36 bytes in .*, 4 more than .*; if its rows are x, y, z alone, add a fourth column"),
        (bytes(20), "got 20 bytes in .*, 4 more than .*; if its rows have 5 columns, as nuScenes writes them"),
        (bytes(60), "12 more than .*; if its rows are x, y, z alone.* or if its rows have 5 columns"),
        (with_cell(1, 0, np.nan), "got 1 of 3 points NaN or infinite coordinates in .*bad_points=drop"),
        (with_cell(1, 2, np.inf), "got 1 of 3 points NaN or infinite coordinates in .*bad_points=drop"),
        (with_cell(1, slice(0, 3), 0), "got 1 of 3 points at the origin .* in .*bad_points=drop"),
        (with_cell(1, 3, 200), "got reflectance from 0.5 to 200 in .*; wanted values in .*divide an intensity"),
        (with_cell(1, 3, np.nan), "got reflectance from nan to nan in "),
    ],
)
def test_read_bin_refuses_in_one_line_that_names_the_file(bin_file, content, text):
    path = bin_file(content)
    with pytest.raises(ScanError, match=text) as refusal:
        read_bin(path)
    assert str(path) in refusal.value.got
    assert "\n" not in str(refusal.value)


def test_read_bin_drops_bad_points_but_no_bad_reflectance(bin_file):
    bad = np.array([[np.nan, 1, 1, 0], [1, -np.inf, 1, 0], [0, 0, 0, 0], [0, -0.0, 0, 9]])
    scan = read_bin(bin_file(np.concatenate((bad, ROWS, bad))), "drop")
    assert np.array_equal(scan.points_xyz_m.numpy(), ROWS[:, :3])
    with pytest.raises(ScanError, match=r"reflectance from 0\.25 to 2 in"):
        read_bin(bin_file(with_cell(0, 3, 2)), "drop")
    with pytest.raises(ScanError, match="got no point in"):
        read_bin(bin_file(bad), "drop")


def test_read_bin_refuses_what_is_no_file_and_does_not_hang(tmp_path):
    os.mkfifo(tmp_path / "pipe.bin")
    (tmp_path / "folder.bin").mkdir()
    (tmp_path / "dangling.bin").symlink_to(tmp_path / "nowhere")
    for name, what in [
        ("pipe", "not a file"),
        ("folder", "not a file"),
        ("dangling", "not there"),
        ("no", "not there"),
    ]:
        with pytest.raises(ScanError, match=f"{name}.bin, which is {what}"):
            read_bin(tmp_path / f"{name}.bin")


def test_read_bin_refuses_a_huge_file_without_reading_it(tmp_path):
    with (tmp_path / "huge.bin").open("wb") as file:
        file.truncate(1 << 40)  # sparse: a terabyte that takes no room
    with pytest.raises(ScanError, match=r"over 4000000 points in .*huge\.bin"):
        read_bin(tmp_path / "huge.bin")


def scan_or_refusal(read) -> Scan | ScanError:
    try:
        return read()
    except ScanError as refusal:
        return refusal


ANY_ROWS = hnp.arrays("<f4", (7, 4), elements=st.floats(width=32))


@settings(max_examples=200, deadline=None)
@given(
    content=st.binary(max_size=400) | ANY_ROWS.map(lambda rows: rows.tobytes()),
    bad_points=st.sampled_from(["refuse", "drop"]),
)
def test_read_bin_of_any_bytes_is_a_scan_or_a_scan_error(tmp_path_factory, content, bad_points):
    path = tmp_path_factory.getbasetemp() / "fuzz.bin"
    path.write_bytes(content)
    scan = scan_or_refusal(lambda: read_bin(path, bad_points))
    if isinstance(scan, Scan):
        assert 0 < len(scan) <= len(content) // 16
    else:
        assert str(path) in scan.got


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
    with pytest.raises(DataError, match=r"'00\+3' .*'3' neither a split nor a sequence there; wanted one of .*03"):
        open_dataset(f"{tmp_path}:00+3")


def test_kitti_360_val_is_in_train_but_not_in_train_without_val(bin_file, tmp_path):
    for drive in (0, 2, 3, 4, 5, 6, 7, 9, 10):
        bin_file(ROWS, f"data_3d_raw/2013_05_28_drive_{drive:04d}_sync/velodyne_points/data/0000000000.bin")
    names = {split: set(names_of(open_dataset(f"kitti_360:{tmp_path}:{split}"))) for split in load("kitti_360").splits}
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


def test_sources_with_colons_brackets_and_places_that_do_not_exist(bin_file, tmp_path, monkeypatch):
    bin_file(ROWS, "a:b[:50%]/000000.bin")
    for source in ("folder:{}", "{}", "folder:{}:all", "{}:all[:100%]", "{}:."):
        assert names_of(open_dataset(source.format(tmp_path / "a:b[:50%]"))) == ["000000"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="nowhere, which is not a folder; wanted the root of a data set"):
        open_dataset(str(tmp_path / "nowhere"))
    with pytest.raises(DataError, match="empty, which holds no layout we know"):
        open_dataset(str(tmp_path / "empty"))
    monkeypatch.chdir(tmp_path)
    bin_file(ROWS, "kitti_raw/000000.bin")
    assert names_of(open_dataset("kitti_raw")) == ["000000"], "a folder that is called as a data set is"


def test_the_wish_to_drop_points_reaches_the_reader(bin_file):
    folder = bin_file(with_cell(0, 0, np.nan)).parent
    with pytest.raises(ScanError, match="bad_points=drop"):
        open_dataset(str(folder)).scan(0)
    assert len(open_dataset(str(folder), bad_points="drop").scan(0)) == 2


def test_a_folder_of_another_format_is_opened_and_told_what_it_holds(bin_file):
    folder = bin_file(bytes(20), "sweep.pcd.bin").parent
    with pytest.raises(ScanError, match="5 columns, as nuScenes"):
        open_dataset(str(folder)).scan(0)


def test_an_example_overwrites_nothing(bin_file, tmp_path):
    path = bin_file(ROWS)
    with pytest.raises(OutputError, match=r"000000\.bin, which exists"):
        load("folder").write_example(tmp_path, 1)
    assert path.stat().st_size == ROWS.nbytes


def test_simulated_splits_share_no_seed():
    first, last = (
        {s: open_dataset(f"simulated:1000000:{s}").name(i) for s in ("train", "val", "test")} for i in (0, -1)
    )
    assert list(first.values()) == ["seed_0000000", "seed_1000000", "seed_2000000"]
    assert list(last.values()) == ["seed_0999999", "seed_1999999", "seed_2999999"]
    assert names_of(open_dataset("simulated:10[90%:]")) == ["seed_0000009"]
    for count in ("0", "-1", "1e3", "1000001", "９" * 5000, "/data"):
        with pytest.raises(DataError, match="where a count belongs; wanted COUNT"):
            open_dataset(f"simulated:{count}")


def png(path, pixels: np.ndarray):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)
    return path


def test_range_images_put_points_on_column_centres(tmp_path):
    pixels = np.zeros((64, 870), dtype=np.uint16)
    pixels[0, 0], pixels[63, 434] = 5000, 65_535
    png(tmp_path / "drive" / "0.png", pixels)
    scan = open_dataset(str(tmp_path)).scan(0)
    assert scan.ring is not None
    assert scan.ring.tolist() == [0, 63]
    assert scan.reflectance is None
    x, y, z = scan.points_xyz_m.double().numpy().T
    assert torch.allclose(scan.points_xyz_m.norm(dim=1), torch.tensor([10.0, 131.07]))
    assert np.allclose(np.degrees(np.arctan2(y, x)), [180 - 180 / 870, 180 / 870], atol=1e-3)
    assert np.allclose(np.degrees(np.arctan2(z, np.hypot(x, y))), [1.94, -25], atol=1e-4)


@pytest.mark.parametrize(
    ("pixels", "text"),
    [
        (
            np.ones((32, 870), np.uint16),
            "a PNG of 32 rows and 870 columns with 16 bits; wanted a 16-bit grey PNG of 64",
        ),
        (np.ones((64, 870), np.uint8), "a PNG of 64 rows and 870 columns with 8 bits;"),
        (np.ones((64, 870, 3), np.uint8), "with 8 bits in colour;"),
        (np.zeros((64, 870), np.uint16), "no return in"),
    ],
)
def test_range_images_refuse_other_images(tmp_path, pixels, text):
    path = png(tmp_path / "drive" / "0.png", pixels)
    with pytest.raises(ScanError, match=text) as refusal:
        load("range_images")(tmp_path).scan(0)
    assert str(path) in str(refusal.value)


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_range_images_of_damaged_bytes_are_a_scan_or_a_scan_error(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "fuzz_png" / "0.png"
    content = bytearray(png(path, np.arange(64 * 87, dtype=np.uint16).reshape(64, 87)).read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1) | st.integers(0, 64))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(0, len(content)) | st.just(len(content)))])
    scan = scan_or_refusal(lambda: load("range_images")(path.parent).scan(0))
    if isinstance(scan, Scan):
        assert scan.ring is not None
    else:
        assert str(path) in scan.got


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
        assert int(rings_from_firing_order(scan.points_xyz_m.numpy()).max()) + 1 == 64, scan.source
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
        with Image.open(dataset.paths[index]) as image:
            stored_m = torch.from_numpy(np.array(image, dtype=np.float32) / 500)
        stored_m[(stored_m < sensor.range_min_m) | (stored_m > sensor.range_max_m)] = 0
        assert torch.allclose(project(scan, as_stored).range_m, stored_m, atol=1e-4), scan.source
        assert project(scan, sensor).return_mask.any()


@pytest.mark.shared
@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("incomplete_sweep_39_rings", "got 39 rings in .*; wanted the 64 rings .*remove the file if the sweep was cut"),
        ("cropped_to_camera", "got returns in only .* of 360 degrees of azimuth in .*; wanted a full revolution"),
        ("all_columns_times_1p1_plus_0p1", "got reflectance from .* to 1.* in .*; wanted values in"),
    ],
)
def test_real_damaged_scans_are_refused(real, file, text):
    path = real / "damaged" / f"{file}.bin"
    with pytest.raises(ScanError, match=text) as refusal:
        project(read_bin(path), load_sensor("hdl64e_kitti_odometry"))
    assert str(path) in refusal.value.got


@pytest.mark.shared
def test_real_files_of_other_formats_are_refused(real):
    files = sorted((real / "formats" / "xyz_only_bin").glob("*")) + sorted((real / "other_sensors").glob("nu*/*"))
    assert len(files) == 5
    for path in files:
        with pytest.raises(ScanError, match=r"x, y, z alone|5 columns|reflectance from|coordinates"):
            read_bin(path)
