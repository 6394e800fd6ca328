"""Files that lie about themselves: refused by their headers, before anything is unpacked or given room."""

import itertools
import re
import struct
import zipfile
from io import BytesIO

import numpy as np
import pytest

from format_examples import example, pcd_files, ply_files, refused_within
from lidargrit.data.formats import candidates, load, read_scan

MEGABYTES_AT_MOST = 20  # each file here is small


@pytest.fixture(scope="module")
def scan():
    return example(load("ply"), columns=4)


@pytest.fixture
def refused(tmp_path):
    """Return a function that writes bytes to a file, which must be refused, and returns the one line."""

    def read(data: bytes, name: str) -> str:
        path = tmp_path / name
        path.write_bytes(data)
        candidates(path)  # loads what all readers need, which is not to be counted
        said = refused_within(path, MEGABYTES_AT_MOST)
        assert str(path) in said
        assert "\n" not in said
        return said

    return read


HUGE = ("-1", "0", "4000001", "2147483648", "18446744073709551617", "9" * 5000, "1e9", "nan", "0x10", "٣", "")


def test_text_that_claims_far_more_rows_than_it_has(refused):
    head = "VERSION 0.7\nFIELDS x y z h\nSIZE 4 4 4 1\nTYPE F F F U\nCOUNT 1 1 1 50\nWIDTH 4000000\nHEIGHT 1\n"
    assert "4000000 rows of 53 numbers" in refused((head + "POINTS 4000000\nDATA ascii\n1 2 3 4\n").encode(), "a.pcd")
    many = "".join(f"property double p{number}\n" for number in range(200))
    head = f"ply\nformat ascii 1.0\nelement vertex 4000000\nproperty float x\n{many}end_header\n"
    assert "4000000 rows of 201 numbers" in refused((head + "1 2 3\n").encode(), "a.ply")


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("count", HUGE)
def test_pcd_of_absurd_counts(refused, scan, encoding, count):
    data = pcd_files(scan.points_xyz_m.numpy(), scan.reflectance.numpy(), scan.ring.numpy())[f"pcd_{encoding}"]
    for key in (
        ("POINTS", "WIDTH", "HEIGHT") if str(count) != "0" else ("POINTS", "HEIGHT")
    ):  # 0 columns: some leave it at that
        refused(re.sub(rf"{key} \d+".encode(), f"{key} {count}".encode(), data), "a.pcd")
    both = re.sub(rb"(POINTS|WIDTH) \d+", rf"\1 {count}".encode(), data)
    refused(both, "a.pcd")
    for key in ("COUNT", "SIZE"):
        refused(re.sub(rf"{key} \d+".encode(), f"{key} {count}".encode(), data), "a.pcd")


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        (b"TYPE F", b"TYPE X", "a field of type 'X' and size 8"),
        (b"SIZE 8", b"SIZE 3", "a field of type 'F' and size 3"),
        (b"COUNT 1", b"COUNT 9999", "counts from 1 to 9999 values a point"),
        (b"FIELDS x", b"FIELDS x y", "7 fields, 6 sizes, 6 types, 6 counts"),
        (
            b"FIELDS x",
            b"FIELDS u",
            "whose columns are 'u', 'y', 'z', 'intensity', 'stamp', 'channel'; wanted x",
        ),
        (b"DATA ", b"ATAD ", "a header that does not end with DATA"),
        (b"DATA binary_compressed", b"DATA zip", "bytes of DATA 'zip'"),
    ],
)
def test_pcd_of_other_headers(refused, scan, old, new, text):
    files = pcd_files(scan.points_xyz_m.numpy(), scan.reflectance.numpy(), scan.ring.numpy())
    assert text in refused(files["pcd_binary_compressed"].replace(old, new, 1), "a.pcd")


def test_pcd_that_would_unpack_to_far_more(refused, scan):
    data = pcd_files(scan.points_xyz_m.numpy(), scan.reflectance.numpy(), scan.ring.numpy())["pcd_binary_compressed"]
    start = data.index(b"binary_compressed\n") + 18
    for packed, unpacked in ((10, 2**32 - 1), (2**32 - 1, 10), (0, 0)):
        lying = data[:start] + struct.pack("<II", packed, unpacked) + data[start + 8 :]
        assert re.search(f"of {packed} bytes, {unpacked} unpacked", refused(lying, "a.pcd"))
    million = re.sub(rb"(POINTS|WIDTH) \d+", rb"\g<1> 4000000", data)
    bomb = million[: million.index(b"_compressed\n") + 12] + struct.pack("<II", 9, 4_000_000 * 27) + bytes(9)
    refused(bomb, "a.pcd")


@pytest.mark.parametrize("count", HUGE)
@pytest.mark.parametrize("name", ["ply_ascii", "ply_binary_big_endian"])
def test_ply_of_absurd_counts(refused, scan, name, count):
    data = ply_files(scan.points_xyz_m.numpy(), scan.reflectance.numpy(), scan.ring.numpy())[name]
    refused(re.sub(rb"vertex \d+", f"vertex {count}".encode(), data), "a.ply")
    if count != "0":
        refused(data.replace(b"camera 1", f"camera {count}".encode()), "a.ply")


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        (b"ascii 1.0", b"utf8 1.0", "the format 'format utf8 1.0'"),
        (b"double y", b"quad y", "'property quad y' in its header"),
        (b"double y", b"double x", "whose columns are 'x', 'z', "),
        (b"property double y", b"property list uchar double y", "row 0, which does not fit its header"),
        (b"property float view", b"property list float int view", "'property list float int view' in its header"),
        (b"element vertex", b"element point", "no vertices"),
        (b"double x", b"double u", "whose columns are 'u', 'y', 'z'"),
        (b"end_header", b"header_end", "no PLY file"),
        (b"ply", b"PLY", "no PLY file"),
    ],
)
def test_ply_of_other_headers(refused, scan, old, new, text):
    data = ply_files(scan.points_xyz_m.numpy(), scan.reflectance.numpy(), scan.ring.numpy())["ply_ascii"]
    assert text in refused(data.replace(old, new, 1), "a.ply")


def test_text_of_lines_that_would_take_twenty_times_their_size(refused):
    endless = b"1 " * 500_000 + b"1\n"
    header = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA ascii\n"
    for name, data in (
        ("a.pcd", header.encode() + endless + b"1 2 3\n"),
        ("a.csv", b"x y z\n1 2 3\n" + endless),
        ("b.csv", b"x,y,z\n" + b"1" * 1_000_000 + b",2,3\n"),
    ):
        assert "a line of more than 65,536 bytes" in refused(data, name)


def test_rows_before_the_vertices_are_counted_together_and_not_split(refused, tmp_path):
    def ply(*counts: int, rows: int) -> bytes:
        before = "".join(f"element e{at} {count}\nproperty float a\n" for at, count in enumerate(counts))
        axes = "".join(f"property float {axis}\n" for axis in "xyz")
        head = f"ply\nformat ascii 1.0\n{before}element vertex 1\n{axes}end_header\n"
        return head.encode() + b"11\n" * rows + b"1 2 3\n"

    assert "8000000 rows before its vertices" in refused(ply(4_000_000, 4_000_000, rows=0), "a.ply")
    assert "299999 of the 300000 rows before its vertices" in refused(ply(300_000, rows=299_998), "a.ply")
    (tmp_path / "b.ply").write_bytes(ply(3, 4, rows=7))
    assert read_scan(tmp_path / "b.ply").points_xyz_m.tolist() == [[1, 2, 3]]


def npy(header: str, body: bytes = bytes(96), version: tuple[int, int] = (1, 0)) -> bytes:
    length = struct.pack("<H" if version == (1, 0) else "<I", len(header))
    return b"\x93NUMPY" + bytes(version) + length + header.encode() + body


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000, 3)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (4000001, 3)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (-8, -3)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (8, 10**30)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 2, 2, 3)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': ()}",
        "{'descr': '|O', 'fortran_order': False, 'shape': (4, 3)}",
        "{'descr': '<c8', 'fortran_order': False, 'shape': (4, 3)}",
        "{'descr': '|V999999999', 'fortran_order': False, 'shape': (4, 3)}",
        "{'descr': [('x', '<f4')], 'fortran_order': False, 'shape': (4,)}",
        "__import__('os').abort()",
        "(" * 1000,
        "-" * 1000 + "1",
        "[" * 9000,
    ],
)
@pytest.mark.parametrize("version", [(1, 0), (2, 0), (3, 0), (9, 9)])
def test_arrays_of_absurd_headers(refused, header, version):
    refused(npy(header, version=version), "a.npy")
    with BytesIO() as buffer:
        with zipfile.ZipFile(buffer, "w") as archive:
            archive.writestr("points.npy", npy(header, version=version))
        refused(buffer.getvalue(), "a.npz")


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_archives_that_would_unpack_to_far_more(refused, method):
    small = npy("{'descr': '<f4', 'fortran_order': False, 'shape': (8, 3)}")
    with BytesIO() as buffer:
        with zipfile.ZipFile(buffer, "w", method) as archive:
            archive.writestr("points.npy", small + bytes(30_000_000))
        data = buffer.getvalue()
    true_size = struct.pack("<I", len(small) + 30_000_000)
    refused(data.replace(true_size, struct.pack("<I", len(small))), "a.npz")
    assert "bytes in one array" in refused(data.replace(true_size, struct.pack("<I", 2**31)), "a.npz")
    if method != zipfile.ZIP_DEFLATED:  # of which zipfile unpacks all at once
        assert f"packed by method {method}" in refused(data, "a.npz")


def test_archives_of_many_arrays_that_each_unpack_to_far_more(refused, tmp_path):
    ones = np.ones(24, "<f4").tobytes()
    points, column = (
        npy(f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}}}", ones) for shape in ("(8, 3)", "(8,)")
    )
    names = ["".join(letters) for letters in itertools.product("Rr", "Ii", "Nn", "Gg")]
    for padding in (bytes(5_000_000), b""):
        with BytesIO() as buffer:
            with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
                archive.writestr("points.npy", points)
                for name in names:
                    archive.writestr(f"{name}.npy", column + padding)
            if padding:
                assert "bytes in one array" in refused(buffer.getvalue(), "a.npz")
            (tmp_path / "b.npz").write_bytes(buffer.getvalue())
    assert read_scan(tmp_path / "b.npz").ring is not None, "the first of sixteen"


def test_archives_whose_directory_is_the_bomb(refused):
    with BytesIO() as buffer:
        with zipfile.ZipFile(buffer, "w") as archive:
            for number in range(3000):
                archive.writestr(f"{number}.npy", b"")
        assert "no directory of at most 65536 bytes at its end" in refused(buffer.getvalue(), "a.npz")


def bombs_of_arrow() -> dict[str, bytes]:
    """Return sweeps of 40 points whose other content unpacks to far more, unseen by who adds up their buffers."""
    pa = pytest.importorskip("pyarrow")
    ipc = pytest.importorskip("pyarrow.ipc")

    def stream(batch, metadata=None) -> bytes:
        with BytesIO() as buffer:
            with ipc.new_stream(buffer, batch.schema, options=ipc.IpcWriteOptions(compression="zstd")) as writer:
                writer.write_batch(batch, custom_metadata=metadata)
            return b"ARROW1\0\0" + buffer.getvalue()

    def columns(count: int) -> dict[str, np.ndarray]:
        return dict.fromkeys("xyz", np.ones(count)) | dict.fromkeys(("intensity", "laser_number"), np.ones(count, "u1"))

    unrelated = pa.DictionaryArray.from_arrays(np.zeros(40, "i1"), np.zeros(30_000_000))
    with_dictionary = stream(pa.record_batch(columns(40) | {"note": unrelated}))
    old = bytearray(stream(pa.record_batch(columns(10_000_000)), {"ARROW:experimental_compression": "ZSTD"}))
    message = 8 + 8 + struct.unpack_from("<i", old, 8 + 4)[0] + 8  # behind the file's mark and the schema

    def field(table: int, which: int) -> tuple[int, int]:
        """Return where a flatbuffers table says where a field lies, and where it lies."""
        entry = table - struct.unpack_from("<i", old, table)[0] + 4 + 2 * which
        return entry, table + struct.unpack_from("<H", old, entry)[0]

    root = message + struct.unpack_from("<I", old, message)[0]
    struct.pack_into("<h", old, field(root, 0)[1], 3)  # version 4
    header = field(root, 2)[1]
    batch = header + struct.unpack_from("<I", old, header)[0]
    struct.pack_into("<H", old, field(batch, 3)[0], 0)  # no compression, where version 5 has it
    return {"dictionary": with_dictionary, "old compression": bytes(old)}


@pytest.mark.parametrize("kind", ["dictionary", "old compression"])
def test_sweeps_that_would_unpack_to_far_more_where_no_size_is_counted(refused, kind):
    data = bombs_of_arrow()[kind]
    assert len(data) < 200_000
    assert "a column with a dictionary, or packed as in 2020" in refused(data, "a.feather")


@pytest.mark.parametrize("kind", [object, complex, "M8[s]", "U5"])
def test_arrays_of_other_than_numbers_are_refused_as_what_they_are(refused, tmp_path, kind):  # no pickle is loaded
    for name in ("o.npy", "o.npz"):
        values = np.ones((9, 4)).astype(int).astype(kind)
        np.savez(tmp_path / name, points=values) if name == "o.npz" else np.save(tmp_path / name, values)
        told = refused((tmp_path / name).read_bytes(), f"a.{name[-3:]}")
        assert f"which holds an array of {values.dtype!r}" in told
        assert told.endswith("save its arrays as numbers, with a row for each point")
