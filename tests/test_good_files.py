"""Files that leave out, or write differently, what their formats leave open: read rightly, and no damage."""

from contextlib import suppress
from io import BytesIO

import numpy as np
import pytest
import torch

from lidargrit.core.errors import ScanError
from lidargrit.data.datasets.shared.files import is_recognised
from lidargrit.data.formats import read_scan
from lidargrit.data.sources import open_source
from lidargrit.scans.projection.sensor_check import closest_sensor
from lidargrit.scans.sensors import load_sensor
from street_corner import corner, pcd_bytes, rows_of, xyz_of

TABLE = corner()
COLUMNS = {**{axis: TABLE[axis] for axis in "xyz"}, "intensity": TABLE["intensity"].astype(np.float32)}
ROWS = rows_of(COLUMNS)
POINTS = len(ROWS)
RIGHT = torch.from_numpy(COLUMNS["intensity"] / np.float32(255))


def check(path, kept=slice(None), bad_points="refuse", with_reflectance=True):
    scan = read_scan(path, 0, bad_points)
    assert torch.equal(scan.points_xyz_m, xyz_of(TABLE)[kept])
    if with_reflectance:
        assert torch.equal(scan.reflectance, RIGHT[kept])
    return scan


def padded(count):
    """Return rows with some bytes of padding before the intensity."""
    table = np.zeros(POINTS, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_", "u1", (count,)), ("intensity", "<f4")])
    for name, values in COLUMNS.items():
        table[name] = values
    return table.tobytes()


PADDED = {"FIELDS": "x y z _ intensity", "SIZE": "4 4 4 1 4", "TYPE": "F F F U F"}


@pytest.mark.parametrize(
    "lines",
    [
        {**PADDED, "COUNT": "1 1 1 0 1"},
        {"HEIGHT": ""},
        {"WIDTH": "0"},
        {"WIDTH": "0", "HEIGHT": "0"},
        {"WIDTH": "", "HEIGHT": ""},
        {"TYPE": "f f f f"},
        {"POINTS": ""},
    ],
    ids=["no values", "no height", "width 0", "size 0", "no size", "small letters", "no points"],
)
@pytest.mark.parametrize("data", ["binary", "ascii"])
def test_liberties_of_pcd_are_taken(tmp_path, lines, data):
    body = None if data == "binary" else "".join(" ".join(map(repr, row)) + "\n" for row in ROWS.tolist()).encode()
    (tmp_path / "a.pcd").write_bytes(pcd_bytes(ROWS, data, body, **lines))
    check(tmp_path / "a.pcd")


def test_padding_of_pcd_is_left_out(tmp_path):
    (tmp_path / "a.pcd").write_bytes(pcd_bytes(ROWS, body=padded(3), **PADDED, COUNT="1 1 1 3 1"))
    check(tmp_path / "a.pcd")


@pytest.mark.parametrize("lines", [{"WIDTH": "7"}, {"POINTS": "0"}, {"COUNT": "0 0 0 0"}, {"WIDTH": "0", "POINTS": ""}])
def test_sizes_that_contradict_are_refused(tmp_path, lines):
    (tmp_path / "a.pcd").write_bytes(pcd_bytes(ROWS, **lines))
    with pytest.raises(ScanError, match="a PCD file of"):
        read_scan(tmp_path / "a.pcd")


NAN_WORDS = ["nan", "-nan", "-nan(ind)", "nan(snan)", "-1.#IND", "1.#QNAN", "-1.#IND0000", "1.#INF"]


def lines_with(word, separator=" "):
    rows = [[word] * 3 + [str(row[3])] if 5 <= at < 9 else map(repr, row) for at, row in enumerate(ROWS.tolist())]
    return "".join(separator.join(row) + "\n" for row in rows).encode()


def ply_head(form, properties, before="", end="\n"):
    lines = f"ply\nformat {form} 1.0\n{before}element vertex {POINTS}\n"
    return (lines + "".join(f"property {one}\n" for one in properties) + "end_header\n").replace("\n", end).encode()


PROPERTIES = [f"float {name}" for name in COLUMNS]
KEPT = [*range(5), *range(9, POINTS)]


@pytest.mark.parametrize("word", NAN_WORDS)
def test_whatever_is_printed_for_no_number_is_none(tmp_path, word):
    (tmp_path / "a.pcd").write_bytes(pcd_bytes(ROWS, "ascii", lines_with(word)))
    (tmp_path / "a.ply").write_bytes(ply_head("ascii", PROPERTIES) + lines_with(word))
    (tmp_path / "a.csv").write_bytes(b"x,y,z,intensity\n" + lines_with(word, ","))
    for suffix in ("pcd", "ply", "csv"):
        check(tmp_path / f"a.{suffix}", KEPT, "drop")
        with pytest.raises(ScanError, match=r"4 of .* points with NaN or infinite coordinates.*--bad-points drop"):
            read_scan(tmp_path / f"a.{suffix}")


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_empty_cells_of_a_table_are_no_numbers(tmp_path, separator):
    head = separator.join(["note", "x", "y", "z", "intensity"]) + "\n"
    rows = [f"{separator}{line}" for line in lines_with("", separator).decode().splitlines()]
    (tmp_path / "a.csv").write_text(head + "\n".join(rows) + "\n\n")
    check(tmp_path / "a.csv", KEPT, "drop")
    (tmp_path / "b.csv").write_text(head + "\r\n".join(row + separator for row in rows))
    check(tmp_path / "b.csv", KEPT, "drop")


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-be"])
def test_tables_of_spreadsheets_are_read(tmp_path, separator, encoding):
    quoted = [separator.join(f'"{word}"' for word in row) for row in [COLUMNS, *ROWS.tolist()]]
    mark = "\ufeff" if encoding == "utf-16-be" else ""  # which Python writes before the others
    (tmp_path / "a.csv").write_bytes((mark + "\r\n".join(quoted)).encode(encoding))
    check(tmp_path / "a.csv")


def test_commas_within_quotation_marks_are_no_decimal_points(tmp_path):
    (tmp_path / "a.csv").write_text('x,y,z,intensity\n"1,5","2","3"\n')
    with pytest.raises(ScanError, match="with a decimal point"):
        read_scan(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text('x;y;z;note\n"1.5";2;"";"a"\n2;3;4;b\n"1.5";2;3;""\n')
    scan = read_scan(tmp_path / "a.csv", bad_points="drop")
    assert len(scan) == 2
    assert "column 'note' left out: not numbers in all lines" in scan.notes
    (tmp_path / "a.csv").write_text("x,y,z,note,gain\n1,2,3,,5\n2,3,4,b,6\n")
    scan = read_scan(tmp_path / "a.csv")
    assert scan.rows.columns["gain"].tolist() == [5, 6], "beside a column whose first line alone is no word"
    assert "column 'note' left out: not numbers in all lines" in scan.notes


def with_lists(lengths, order):
    out = BytesIO()
    for row, length in zip(ROWS, lengths, strict=True):
        out.write(np.array(row.tolist(), order + "f4").tobytes() + bytes([length]) + bytes(4 * length))
    return out.getvalue()


FACES = "element face 2\nproperty list uchar int vertex_indices\n"


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("lengths", [[1] * POINTS, [0] * POINTS, [at % 3 for at in range(POINTS)]])
@pytest.mark.parametrize("with_faces", [False, True])
def test_lists_of_ply_are_left_out(tmp_path, order, lengths, with_faces):
    sign = {"little": "<", "big": ">"}[order]
    faces = b"\3" + np.arange(3, dtype=sign + "i4").tobytes() + b"\4" + np.arange(4, dtype=sign + "i4").tobytes()
    head = ply_head(f"binary_{order}_endian", [*PROPERTIES, "list uchar float d"], FACES if with_faces else "")
    (tmp_path / "a.ply").write_bytes(head + (faces if with_faces else b"") + with_lists(lengths, sign))
    check(tmp_path / "a.ply")
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-1])
    with pytest.raises(ScanError, match="bytes"):
        read_scan(tmp_path / "a.ply")


def test_lists_in_text_are_left_out(tmp_path):
    head = ply_head("ascii", ["list uchar float d", *PROPERTIES], FACES)
    rows = [" ".join(["2 0.5 0.5" if at % 2 else "0", *map(repr, row)]) for at, row in enumerate(ROWS.tolist())]
    body = "3 0 1 2\n4 0 1 2 3\n" + "\n".join(rows) + "\n"
    (tmp_path / "a.ply").write_bytes(head + body.encode())
    check(tmp_path / "a.ply")
    (tmp_path / "b.ply").write_bytes(head + body[: len(body) // 2].encode())
    with pytest.raises(ScanError, match="a PLY file of"):
        read_scan(tmp_path / "b.ply")


def test_no_faces_a_property_twice_and_other_line_ends(tmp_path):
    none = FACES.replace("face 2", "face 0")
    (tmp_path / "a.ply").write_bytes(ply_head("binary_little_endian", PROPERTIES, none) + ROWS.tobytes())
    check(tmp_path / "a.ply")
    twice = b"".join(row.tobytes() + bytes(4) for row in ROWS)
    (tmp_path / "b.ply").write_bytes(ply_head("binary_little_endian", [*PROPERTIES, "float x"]) + twice)
    check(tmp_path / "b.ply")
    (tmp_path / "c.ply").write_bytes(ply_head("binary_little_endian", PROPERTIES, end="\r") + ROWS.tobytes())
    check(tmp_path / "c.ply")
    (tmp_path / "d.ply").write_bytes((ply_head("ascii", PROPERTIES) + lines_with("0")).replace(b"\n", b"\r"))
    check(tmp_path / "d.ply", KEPT, "drop")


def test_arrays_by_name_by_column_and_organised(tmp_path):
    bare = np.stack(list(COLUMNS.values()), axis=1)
    more = np.zeros(POINTS, [*ROWS.dtype.descr, ("normal", "<f4", (3,))])
    for name in COLUMNS:
        more[name] = ROWS[name]
    arrays = {"named": ROWS, "named_with_vectors": more, "by_column": np.ascontiguousarray(bare.T)}
    for name, array in {**arrays, "organised": bare[: POINTS // 2 * 2].reshape(2, -1, 4)}.items():
        np.save(tmp_path / f"{name}.npy", array)
        check(tmp_path / f"{name}.npy", slice(POINTS // 2 * 2) if name == "organised" else slice(None))
        assert open_source(str(tmp_path / f"{name}.npy")).kind == "scans"
    for name, array in arrays.items():
        np.savez(tmp_path / f"{name}.npz", array)
        check(tmp_path / f"{name}.npz")
    named = {"axes": dict(zip(("x", "Y", "z"), bare.T[:3], strict=True)), "cloud": {"pc": bare[:, :3]}}
    for name, points in {"a": {"points": bare[:, :3]}, **named}.items():
        np.savez(tmp_path / f"{name}.npz", **points, reflectance=bare[:, 3:])
        check(tmp_path / f"{name}.npz")
        assert open_source(str(tmp_path / f"{name}.npz")).kind == "scans"


def test_one_array_of_another_name_is_a_scan_only_if_it_has_rows_of_points(tmp_path):
    for name, array in {"K": np.eye(3), "pose": np.eye(4), "image": np.zeros((20, 30, 3)), "t": np.zeros(90)}.items():
        np.savez(tmp_path / "a.npz", **{name: array})
        assert not is_recognised(tmp_path / "a.npz"), name
        with pytest.raises(ScanError, match=f"holds the arrays '{name}'.*call the array of points 'points'"):
            read_scan(tmp_path / "a.npz")
    np.savez(tmp_path / "none.npz")
    with pytest.raises(ScanError, match="which holds no array; wanted"):
        read_scan(tmp_path / "none.npz")
    np.savez(tmp_path / "a.npz", K=np.tile([[3.0, 4.0, 5.0]], (16, 1)))
    assert is_recognised(tmp_path / "a.npz")
    assert len(read_scan(tmp_path / "a.npz")) == 16


def test_files_of_carla_with_fewer_than_two_points_are_read_without_a_warning(tmp_path, recwarn):
    for count in (0, 1):
        rows = {axis: np.ones(count, np.float32) for axis in "xyz"}
        np.savez(tmp_path / "a.npz", **rows, cosangle=np.ones(count))
        with suppress(ScanError):
            assert len(read_scan(tmp_path / "a.npz")) == count
    assert not recwarn.list


def test_a_fourth_column_of_rings_is_no_reflectance(tmp_path):
    np.save(tmp_path / "a.npy", np.c_[xyz_of(TABLE).numpy(), TABLE["ring"]].astype(np.float32))
    scan = check(tmp_path / "a.npy", with_reflectance=False)
    assert scan.reflectance is None
    assert scan.ring.tolist() == TABLE["ring"].tolist()
    np.save(tmp_path / "b.npy", np.c_[xyz_of(TABLE).numpy(), np.round(TABLE["intensity"] / 16)].astype(np.float32))
    assert read_scan(tmp_path / "b.npy").ring is None


@pytest.mark.parametrize("odd", [0, 1])
def test_rows_of_nclt_are_read_with_y_to_the_left_and_z_up(tmp_path, odd):
    sensor = load_sensor("hdl32e")
    points = xyz_of(corner(0, sensor, 128)).double().numpy()
    points = points[np.random.default_rng(0).permutation(len(points))][: len(points) // 2 * 2 - odd]
    rows = np.zeros(len(points), [("x", "<u2"), ("y", "<u2"), ("z", "<u2"), ("intensity", "u1"), ("laser", "u1")])
    for axis, values in zip("xyz", (points * (1, -1, -1)).T, strict=True):  # the sensor's own axes
        rows[axis] = np.round((values + 100) / 0.005)
    rows["intensity"], rows["laser"] = np.arange(len(rows)) % 256, np.arange(len(rows)) % 32
    (tmp_path / "1326030975726043.bin").write_bytes(rows.tobytes())
    scan = read_scan(tmp_path / "1326030975726043.bin")
    assert np.abs(scan.points_xyz_m.numpy() - points).max() < 0.0026  # half a step
    assert torch.equal(scan.reflectance, torch.arange(len(rows)).remainder(256) / 255)
    assert closest_sensor(scan) == "hdl32e"
    (tmp_path / "b.bin").write_bytes(rows.tobytes()[:-1])
    with pytest.raises(ScanError, match="more than whole points"):
        read_scan(tmp_path / "b.bin")
