"""The readers of single files: what they read, number for number, what they refuse, and real files."""

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image
from pypcd4.pypcd4 import PointCloud

from format_examples import example, numpy_files, pcd_files, ply_files
from lidargrit.core.errors import OutputError, ScanError
from lidargrit.data.formats import candidates, load, read_scan, recognise, stem
from lidargrit.data.formats.kitti_bin import KittiBin
from lidargrit.data.formats.xyz_bin import XyzBin
from lidargrit.scans.projection import project
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import Scan

ROWS = np.array([[1, 2, 3, 0.5], [4, 5, 6, 0.25], [7, 8, 9, 1]], dtype="<f4")


@pytest.fixture
def file(tmp_path):
    """Return a function that writes rows or bytes and returns the path."""

    def write(content: np.ndarray | bytes, name: str = "000000.bin"):
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.astype("<f4").tobytes())
        return tmp_path / name

    return write


@pytest.fixture(scope="module")
def scan() -> Scan:
    return example(load("ply"), columns=16)


def refusal(path) -> str:
    with pytest.raises(ScanError) as refused:
        read_scan(path)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)
    return str(refused.value)


def with_cell(row: int, column: int | slice, value: float) -> np.ndarray:
    rows = ROWS.copy()
    rows[row, column] = value
    return rows


def test_the_longest_ending_counts(tmp_path):
    assert [one.public_name() for one in candidates(tmp_path / "a.PCD.bin")] == ["nuscenes_bin"]
    assert [one.public_name() for one in candidates(tmp_path / "a.b.bin")] == ["kitti_bin", "nclt_bin", "xyz_bin"]
    assert [stem(tmp_path / name) for name in ("a.pcd.bin", "a.b.bin", "a.pcd", "a.b.txt")] == ["a", "a.b", "a", "a.b"]
    (tmp_path / "a.txt").write_text("no scan")
    with pytest.raises(ScanError, match=r"a\.txt, whose ending we do not know; wanted one of \.bag, \.bin, "):
        recognise(tmp_path / "a.txt")


# ------------------------------------------------------------------------------------------------------ bare rows


def test_kitti_rows_are_kept_in_their_order(file):
    path = file(ROWS)
    scan = read_scan(str(path))
    assert np.array_equal(scan.points_xyz_m.numpy(), ROWS[:, :3])
    assert scan.reflectance is not None
    assert np.array_equal(scan.reflectance.numpy(), ROWS[:, 3])
    assert (scan.ring, scan.label, scan.source) == (None, None, str(path))


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"", "got an empty file, .*; wanted float32 rows x, y, z, reflectance, 16 bytes a point; download it again"),
        (bytes(33), "got 33 bytes in .*, 1 more than whole points; .*; download it again: the file was cut short"),
        (bytes(20), "got 20 bytes in .*, 4 more than .*; if its rows have 5 columns, as nuScenes writes them"),
        (with_cell(1, 0, np.nan), "got 1 of 3 points with NaN or infinite coordinates in .*--bad-points drop"),
        (with_cell(1, 2, np.inf), "got 1 of 3 points with NaN or infinite coordinates in .*--bad-points drop"),
        (with_cell(1, slice(0, 3), 0), "got 1 of 3 points at the origin .* in .*--bad-points drop"),
        (with_cell(1, 3, 200), "got reflectance from 0.5 to 200 in .*; wanted values in .*divide an intensity"),
        (with_cell(1, 3, np.nan), "got 1 of 3 points with NaN for reflectance in "),
    ],
)
def test_kitti_rows_are_refused_in_one_line_that_names_the_file(file, content, text):
    path = file(content)
    with pytest.raises(ScanError, match=text) as refused:
        KittiBin.read(path)
    assert str(path) in refused.value.got
    assert "\n" not in str(refused.value)


def test_bad_points_are_dropped_but_no_bad_reflectance(file):
    bad = np.array([[np.nan, 1, 1, 0], [1, -np.inf, 1, 0], [0, 0, 0, 0], [0, -0.0, 0, 9]])
    scan = read_scan(file(np.concatenate((bad, ROWS, bad))), bad_points="drop")
    assert np.array_equal(scan.points_xyz_m.numpy(), ROWS[:, :3])
    with pytest.raises(ScanError, match=r"reflectance from 0\.25 to 2 in"):
        KittiBin.read(file(with_cell(0, 3, 2)), bad_points="drop")
    with pytest.raises(ScanError, match="got no point in"):
        read_scan(file(bad), bad_points="drop")


ANY_ROWS = hnp.arrays("<f4", (7, 4), elements=st.floats(width=32))


@settings(max_examples=200, deadline=None)
@given(
    content=st.binary(max_size=400) | ANY_ROWS.map(lambda rows: rows.tobytes()),
    bad_points=st.sampled_from(["refuse", "drop"]),
)
def test_any_bytes_are_a_scan_or_a_scan_error(tmp_path_factory, content, bad_points):
    path = tmp_path_factory.getbasetemp() / "fuzz.bin"
    path.write_bytes(content)
    try:
        scan = read_scan(path, 0, bad_points)
    except ScanError as refused:
        scan = refused
    assert str(path) in scan.got if isinstance(scan, ScanError) else 0 < len(scan) <= len(content) // 12


@pytest.mark.parametrize("shuffled", [False, True])
@pytest.mark.parametrize("highest", [1, 255])
def test_bare_and_kitti_rows_are_told_apart_by_their_content(file, scan, shuffled, highest):
    order = np.random.default_rng(0).permutation(len(scan)) if shuffled else np.arange(len(scan))
    rows = np.column_stack((scan.points_xyz_m.numpy(), scan.reflectance.numpy() * highest))[order]
    for points in (12 * 4, 12 * 40, len(rows) // 12 * 12):  # whole rows of both kinds
        assert recognise(file(rows[:points, :3])).public_name() == "xyz_bin"
        assert recognise(file(rows[:points])).public_name() == "kitti_bin"
        assert recognise(file(rows[:points].tobytes()[:-16])).public_name() == "kitti_bin"
        for cut in range(1, 16):  # of which some leave whole bare rows
            assert "download it again" in refusal(file(rows[:points].astype("<f4").tobytes()[:-cut]))


def test_bare_rows_may_hold_placeholders(file, scan):
    rows = scan.points_xyz_m.numpy().copy()
    rows[::7] = np.nan
    assert len(read_scan(file(rows), bad_points="drop")) == len(rows) - len(rows[::7])
    rows[1, 1] = 1e30
    with pytest.raises(ScanError, match=r"a coordinate of 1e\+30 m in .*; wanted float32 rows x, y, z, 12 bytes"):
        load("xyz_bin").read(file(rows))


# ------------------------------------------------------------------------------------------------- named columns


@pytest.mark.parametrize("name", ["pcd_ascii", "pcd_binary", "pcd_binary_compressed"])
def test_pcd_of_another_library_is_read_to_the_number(file, scan, name):
    data = pcd_files(scan.points_xyz_m.numpy(), scan.reflectance.numpy(), scan.ring.numpy())[name]
    got = read_scan(file(data, f"{name}.pcd"))
    assert torch.equal(got.points_xyz_m, scan.points_xyz_m)
    assert torch.allclose(got.reflectance, (scan.reflectance * 255).round() / 255)
    assert torch.equal(got.ring, scan.ring), "they rise with elevation in the file, and are turned round"
    assert got.label is None


def test_pcd_that_we_write_is_read_by_another_library(tmp_path, scan):
    load("pcd").write(tmp_path / "a.pcd", scan)
    cloud = PointCloud.from_path(tmp_path / "a.pcd")
    assert cloud.fields == ("x", "y", "z", "intensity", "ring", "label")
    assert np.array_equal(cloud.numpy(("x", "y", "z")), scan.points_xyz_m.numpy())
    for name, values in (("intensity", scan.reflectance), ("ring", scan.ring), ("label", scan.label)):
        assert np.array_equal(cloud.pc_data[name], values.numpy())


@pytest.mark.parametrize("name", ["ply_ascii", "ply_binary_little_endian", "ply_binary_big_endian"])
def test_ply_is_read_as_another_library_reads_it(file, scan, name):
    path = file(ply_files(scan.points_xyz_m.numpy(), scan.reflectance.numpy(), scan.ring.numpy())[name], "a.ply")
    got = read_scan(path)
    assert torch.equal(got.points_xyz_m, scan.points_xyz_m)
    assert torch.allclose(got.reflectance, (scan.reflectance * 255).round() / 255)
    assert torch.equal(got.ring, scan.ring)
    if name != "ply_ascii":  # which trimesh reads only without other elements
        vertices = trimesh.load(path, process=False).vertices
        assert np.array_equal(vertices.astype(np.float32), got.points_xyz_m.numpy())


def test_ply_that_we_write_is_read_by_another_library_and_the_other_way_round(tmp_path, scan):
    load("ply").write(tmp_path / "a.ply", scan)
    raw = trimesh.load(tmp_path / "a.ply").metadata["_ply_raw"]["vertex"]["data"]
    assert np.array_equal(np.stack([raw[axis] for axis in "xyz"], axis=1), scan.points_xyz_m.numpy())
    for name, values in (("intensity", scan.reflectance), ("ring", scan.ring), ("label", scan.label)):
        assert np.array_equal(raw[name], values.numpy())
    for encoding in ("binary", "ascii"):
        data = trimesh.PointCloud(scan.points_xyz_m.numpy()).export(None, "ply", encoding=encoding)
        (tmp_path / "b.ply").write_bytes(data)
        assert torch.allclose(read_scan(tmp_path / "b.ply").points_xyz_m, scan.points_xyz_m, atol=1e-4)


def test_numpy_arrays_of_any_type_and_order(file, scan):
    for name, data in numpy_files(*(one.numpy() for one in (scan.points_xyz_m, scan.reflectance, scan.ring))).items():
        got = read_scan(file(data, name))
        assert torch.equal(got.points_xyz_m, scan.points_xyz_m), name
        if "xyz" in name:
            assert (got.reflectance, got.ring) == (None, None)
        else:
            assert torch.allclose(got.reflectance, scan.reflectance, atol=1 / 65_535), name
            assert torch.equal(got.ring, scan.ring), name


@pytest.mark.parametrize("suffix", [".pcd", ".ply", ".npz", ".npy"])
def test_what_is_written_is_read_back_to_the_bit(tmp_path, scan, suffix):
    path = tmp_path / f"a{suffix}"
    candidates(path)[0].write(path, scan)
    back = read_scan(path)
    for name in ("points_xyz_m", "reflectance", "ring", *(() if suffix == ".npy" else ("label",))):
        assert torch.equal(getattr(back, name), getattr(scan, name)), name
    too_high = Scan(torch.ones(1, 3), ring=torch.tensor([70_000]))
    with pytest.raises(OutputError, match="rings from 70000 to 70000; wanted 0 to 65535"):
        candidates(path)[0].write(path, too_high)


@pytest.mark.parametrize(
    ("highest", "kind", "scale"),
    [
        (1, "f4", 1),
        (0.2, "f8", 1),
        (1.5, "f4", 255),
        (255, "u1", 255),
        (1, "u1", 255),
        (100, "u2", 255),
        (256, "f4", 65_535),
    ],
)
def test_reflectance_is_divided_by_the_smallest_scale_that_holds_it(tmp_path, highest, kind, scale):
    values = np.array([0, highest / 2, highest]).astype(kind)
    np.savez(tmp_path / "a.npz", points=np.ones((3, 3)), Intensity=values)
    assert np.allclose(read_scan(tmp_path / "a.npz").reflectance, values.astype(np.float64) / scale)


def test_reflectance_a_little_beyond_1_is_1(tmp_path):
    np.savez(tmp_path / "a.npz", points=np.ones((3, 3)), intensity=np.array([0.2, 1.0001, 0.5]))
    assert torch.allclose(read_scan(tmp_path / "a.npz").reflectance, torch.tensor([0.2, 1.0, 0.5]))


def test_half_precision_will_do(tmp_path):
    half = np.arange(6, dtype=np.float16)
    np.savez(tmp_path / "a.npz", points=np.ones((6, 3), np.float16), ring=half, label=half, intensity=half)
    scan = read_scan(tmp_path / "a.npz")
    assert scan.ring.tolist() == scan.label.tolist() == list(range(6))
    assert torch.allclose(scan.reflectance, torch.arange(6) / 255)


@pytest.mark.parametrize("values", [[0, np.inf], [0, np.nan]])
def test_reflectance_beyond_all_scales_is_refused(tmp_path, values):
    np.savez(tmp_path / "a.npz", points=np.ones((2, 3)), reflectance=np.array(values))
    told = "got 1 of 2 points with NaN for reflectance" if np.isnan(values).any() else "got reflectance from "
    assert told in refusal(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("arrays", "text"),
    [
        ({"ring": [0.5, 1]}, "a ring that is not whole or out of bounds"),
        ({"ring": [-1, 1]}, "a ring that is not whole or out of bounds"),
        ({"ring": [-5, -5], "points": np.eye(3)[1:]}, "a ring that is not whole or out of bounds"),
        ({"ring": [np.nan, 1]}, "a ring that is not whole or out of bounds"),
        ({"label": [0, 2**32]}, "a label that is not whole or out of bounds"),
        ({"ring": [0, 1, 2]}, r"2 points, but ring of shape \(3,\)"),
        ({"ring": [[0, 0], [1, 1]]}, r"2 points, but ring of shape \(2, 2\)"),
        ({"points": np.ones((2, 6))}, r"an array of shape \(2, 6\).*keep x, y, z, intensity, ring of each point"),
        (
            {"points": np.ones(8)},
            r"of shape \(8,\).*into rows, such as array.view\(np.float32\).reshape\(-1, 4\)",
        ),
        ({"points": np.ones((2, 3), complex)}, "an array of dtype"),
        ({"points": np.zeros((0, 3))}, "no point in"),
        ({"points": np.array([[None] * 3] * 2)}, "an array of dtype"),
    ],
)
def test_archives_of_other_arrays_are_refused(tmp_path, arrays, text):
    np.savez(tmp_path / "a.npz", **{"points": np.ones((2, 3)), **{name: np.array(v) for name, v in arrays.items()}})
    with pytest.raises(ScanError, match=text):
        load("numpy_array").read(tmp_path / "a.npz")


def test_samples_of_ours_are_no_scans_and_say_so_as_do_other_arrays(tmp_path):
    np.savez(tmp_path / "1.npz", pc=np.ones((2, 3)), more=np.ones((2, 3)))
    assert refusal(tmp_path / "1.npz").endswith("; call the array of points 'points'")
    np.savez(tmp_path / "0.npz", range_m=np.ones((64, 256)))
    assert not load("numpy_array").recognises(tmp_path / "0.npz")
    assert refusal(tmp_path / "0.npz").endswith(f"; name the whole folder: {tmp_path}")


def test_rows_that_are_nan_are_placeholders_of_ordered_clouds(file, scan):
    rows = np.column_stack((scan.points_xyz_m.numpy(), scan.reflectance.numpy(), scan.ring.numpy()))
    rows = rows[: len(rows) // 2 * 2]
    rows[::3] = np.nan
    text = "".join(f"{x} {y}\t{z}  {i} {r}\r\n" for x, y, z, i, r in rows)
    head = "# made by hand\nVERSION 0.6\nFIELDS x y z intensity ring\nSIZE 4 4 4 4 2\nTYPE F F F F U\n"
    head += f"WIDTH {len(rows) // 2}\nHEIGHT 2\nPOINTS {len(rows)}\nDATA ascii\n"
    path = file((head + text).encode(), "ordered.pcd")
    assert "points with NaN or infinite coordinates in" in refusal(path)
    got, kept = read_scan(path, bad_points="drop"), np.flatnonzero(np.isfinite(rows).all(axis=1))
    assert torch.allclose(got.points_xyz_m, scan.points_xyz_m[kept])
    assert torch.equal(got.ring, scan.ring[kept])


# -------------------------------------------------------------------------------------------------- range images


def png(path, pixels: np.ndarray):
    Image.fromarray(pixels).save(path)
    return path


def test_range_images_put_points_on_column_centres(tmp_path):
    pixels = np.zeros((64, 870), dtype=np.uint16)
    pixels[0, 0], pixels[63, 434] = 5000, 65_535
    scan = read_scan(png(tmp_path / "0.png", pixels))
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
        (np.ones((32, 870), np.uint16), "32 rows and 870 columns with 16 bits; wanted a 16-bit grey PNG of 64"),
        (np.ones((64, 870), np.uint8), "a PNG of 64 rows and 870 columns with 8 bits;"),
        (np.ones((64, 870, 3), np.uint8), "with 8 bits in colour;"),
        (np.zeros((64, 870), np.uint16), "no return in"),
    ],
)
def test_other_images_are_refused(tmp_path, pixels, text):
    assert text in refusal(png(tmp_path / "0.png", pixels))


# --------------------------------------------------------------------------------------------------- real files


@pytest.mark.shared
@pytest.mark.parametrize(
    ("file", "name", "points", "highest"),
    [
        ("formats/pcd/000011.pcd", "pcd", 120_945, 0.99),
        ("formats/pcd/kitti_raw_0000000001.pcd", "pcd", 123_683, 0.99),
        ("formats/xyz_only_bin/001000.bin", "xyz_bin", 122_468, None),
        ("formats/xyz_only_bin/001004.bin", "xyz_bin", 124_365, None),
        ("formats/xyz_only_bin/001008.bin", "xyz_bin", 122_614, None),
        ("other_sensors/vlp16_like/000000.pcd", "pcd", 22_988, None),
    ],
)
def test_real_files_are_told_by_their_content(real, file, name, points, highest):
    assert recognise(real / file).public_name() == name
    scan = read_scan(real / file, bad_points="drop")
    assert len(scan) == points
    assert scan.reflectance is None if highest is None else abs(float(scan.reflectance.max()) - highest) < 1e-6
    assert 1 < float(scan.points_xyz_m.norm(dim=1).median()) < 30, "coordinates are metres"


@pytest.mark.shared
def test_real_placeholder_is_refused_unless_dropped(real):
    assert "got 1 of 123684 points at the origin" in refusal(real / "formats" / "pcd" / "kitti_raw_0000000001.pcd")


@pytest.mark.shared
def test_real_scan_as_pcd_is_the_same_scan_as_bin(real):
    """KITTI odometry 00, frame 11, which another program filtered and turned into a PCD of 0..255."""
    pcd = read_scan(real / "formats" / "pcd" / "000011.pcd")
    kitti = read_scan(real / "kitti_odometry" / "sequences" / "00" / "velodyne" / "000011.bin")
    index_of = {point: index for index, point in enumerate(map(tuple, kitti.points_xyz_m.tolist()))}
    found = [
        (index, index_of[point])
        for index, point in enumerate(map(tuple, pcd.points_xyz_m.tolist()))
        if point in index_of
    ]
    assert len(found) > 0.9 * len(pcd)
    mine, theirs = torch.tensor(found).T
    assert torch.allclose(pcd.reflectance[mine], kitti.reflectance[theirs], atol=0.002)


@pytest.mark.shared
@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("incomplete_sweep_39_rings", "got 39 rings in .*; wanted the 64 rings .*remove the file if the scan was cut"),
        ("cropped_to_camera", "got returns in only .* of 360 degrees of azimuth in .*; wanted a full revolution"),
        ("all_columns_times_1p1_plus_0p1", "got reflectance from .* to 1.* in .*; wanted values in"),
    ],
)
def test_real_damaged_scans_are_refused(real, file, text):
    path = real / "damaged" / f"{file}.bin"
    with pytest.raises(ScanError, match=text) as refused:
        project(read_scan(path), load_sensor("hdl64e_kitti_odometry"))
    assert str(path) in refused.value.got


def test_bare_coordinates_that_could_not_be_read_back_are_not_written(tmp_path):
    far = Scan(torch.tensor([[1001.0, 0.0, 0.0]]), source="a far point")
    with pytest.raises(OutputError, match=r"a coordinate of 1001 m in a far point.*at most 1000 m"):
        XyzBin.write(tmp_path / "far.bin", far)
    assert not list(tmp_path.iterdir())
