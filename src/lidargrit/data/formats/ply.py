"""PLY files, text or binary of either byte order ⇄ :class:`Scan`."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidargrit.core.errors import ScanError, first_words
from lidargrit.core.files import atomic_path
from lidargrit.data.formats import POINTS_AT_MOST, BadPoints, read_bytes
from lidargrit.data.formats.shared.carla import mirrored
from lidargrit.data.formats.shared.columns import (
    BYTES_AT_MOST,
    ColumnFormat,
    begins_as,
    check_lines,
    in_one_word,
    little_endian,
    plain_text,
    scan_of_columns,
    text_rows,
    whole_number,
)
from lidargrit.data.formats.shared.ply_elements import Element, Property, binary_rows, text_columns
from lidargrit.scans.types import Scan

_FORMAT = "a PLY file whose vertices have x, y and z"
_HEADER_BYTES_AT_MOST = 65_536  # real ones take 200 bytes to a few kB of comments
_PROPERTIES_AT_MOST = 256  # of one element; real ones have 3 to 70
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_TYPE_NAMES = {kind: name for name, kind in reversed(_TYPES.items())}  # of what is written: char before int8


_OF_CARLA = re.compile(rb"property float32 (I|CosAngle)\s")  # of its LiDAR and its semantic LiDAR


class Ply(ColumnFormat):
    """Polygon files, of which only the vertices are read.

    Properties are found by their names, with or without the "scalar_" that CloudCompare puts before them: x, y, z, and
    if they are there reflectance (or reflectivity, intensity, remission, i), ring (or channel) and label. Written files
    are binary, little-endian. Files that CARLA saves, which name ``float32 I``, are left-handed and mirrored back.

    Source:
        Turk, The PLY Polygon File Format, 1994; the names of types of fixed size are of later programs.
    """

    title = "PLY (polygon file)"
    suffixes = (".ply",)

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether a file begins with a header of PLY."""
        return begins_as(path, _HEADER_BYTES_AT_MOST, _Header.parse)

    @staticmethod
    def read(path: Path, index: int = 0, bad_points: BadPoints = "refuse") -> Scan:
        """Read the scan in a file."""
        data = read_bytes(path, BYTES_AT_MOST, _FORMAT)
        header = _Header.parse(data, path)
        try:
            columns = _binary(data, header) if header.byte_order else _text(data, header, path)
        except ValueError as error:
            if isinstance(error, ScanError):
                raise
            raise _refused(first_words(error), path) from None
        scan = scan_of_columns(columns, path, bad_points)
        return mirrored(scan) if _OF_CARLA.search(data[: header.end]) else scan

    @classmethod
    def write_columns(cls, path: Path, columns: Mapping[str, np.ndarray]) -> None:
        """Write columns to a new binary file; whole numbers of 64 bits, which PLY has not, as doubles."""
        columns = {name: little_endian(values, _TYPE_NAMES) for name, values in in_one_word(columns).items()}
        lines = [f"property {_TYPE_NAMES[values.dtype.str[1:]]} {name}" for name, values in columns.items()]
        count = len(next(iter(columns.values())))
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *lines, "end_header", ""]
        rows = np.rec.fromarrays(list(columns.values()), [(name, values.dtype) for name, values in columns.items()])
        with atomic_path(path) as temporary:
            temporary.write_bytes("\n".join(header).encode() + rows.tobytes())


@dataclass(frozen=True)
class _Header:
    """What the first lines of a file say, after it has been checked.

    Args:
        byte_order: numpy's sign for the byte order; empty for text.
        end: position of the first element in the file, in bytes.
    """

    byte_order: str
    before: list[Element]
    vertices: Element
    end: int
    line_end: bytes

    @classmethod
    def parse(cls, data: bytes, path: Path) -> "_Header":
        line_end = b"\r" if data[:4] == b"ply\r" and data[4:5] != b"\n" else b"\n"
        lines, end = _lines(data, line_end, path)
        match lines[1:2]:
            case [["format", encoding, *_]] if encoding in _BYTE_ORDERS:
                byte_order = _BYTE_ORDERS[encoding]
            case other:
                raise _refused(f"the format {' '.join(other[0] if other else [])[:40]!r}", path)
        elements = _elements(lines[2:], path)
        index = next((index for index, element in enumerate(elements) if element.name == "vertex"), None)
        if index is None:
            raise _refused("no vertices", path)
        before, vertices = elements[:index], elements[index]
        if not 0 < vertices.rows <= POINTS_AT_MOST:
            raise _refused(f"{vertices.rows} vertices", path)
        rows_before = [element.rows for element in before]
        if min(rows_before, default=0) < 0 or sum(rows_before) > POINTS_AT_MOST:
            raise _refused(f"{sum(rows_before)} rows before its vertices", path)
        return cls(byte_order, before, vertices, end, line_end)


def _binary(data: bytes, header: _Header) -> dict[str, np.ndarray]:
    start = header.end
    for element in header.before:
        _, start = binary_rows(data, start, element, header.byte_order)
    return binary_rows(data, start, header.vertices, header.byte_order)[0]


def _text(data: bytes, header: _Header, path: Path) -> dict[str, np.ndarray]:
    below = _below(data, header, path).replace(b"\r", b"\n")  # of two line ends the second is an empty line
    vertices = header.vertices
    if vertices.has_lists:
        check_lines(below, path, _FORMAT)
        return text_columns(plain_text(below), vertices)
    names = [f"{at}" for at in range(len(vertices.properties))]
    columns = text_rows(below, vertices.rows, names, path, _FORMAT)
    return {name: columns[f"{at}"] for name, at in vertices.single().items()}


def _below(data: bytes, header: _Header, path: Path) -> bytes:
    """Return the text below the rows of the elements before the vertices, without making lines of those."""
    end, rows_before = header.end, sum(element.rows for element in header.before)
    for row in range(rows_before):
        end = data.find(header.line_end, end) + 1
        if not end:
            raise _refused(f"{row} of the {rows_before} rows before its vertices", path)
    return data[end:]


def _lines(data: bytes, line_end: bytes, path: Path) -> tuple[list[list[str]], int]:
    """Return the words of every line of the header, comments left out, and where the elements begin."""
    lines: list[list[str]] = []
    end = 0
    while lines[-1:] != [["end_header"]]:
        start, end = end, data.find(line_end, end, _HEADER_BYTES_AT_MOST) + 1
        words = data[start:end].decode("latin1").split()
        if not end or (start == 0 and words != ["ply"]):
            raise ScanError(f"{path}, which is no PLY file", _FORMAT, "convert the file, or download it again")
        if words and words[0] not in ("comment", "obj_info"):
            lines.append(words)
    return lines[:-1], end


def _elements(lines: list[list[str]], path: Path) -> list[Element]:
    elements: list[Element] = []
    for line in lines:
        match line:
            case ["element", name, count]:
                elements.append(Element(name, whole_number(count), []))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append(Property(name, _TYPES[kind]))
            case ["property", "list", count, kind, name] if (
                elements and kind in _TYPES and _TYPES.get(count, "f")[0] != "f"
            ):
                elements[-1].properties.append(Property(name, _TYPES[kind], _TYPES[count]))
            case _:
                raise _refused(f"{' '.join(line)[:60]!r} in its header", path)
        if elements and len(elements[-1].properties) > _PROPERTIES_AT_MOST:
            raise _refused(f"over {_PROPERTIES_AT_MOST} properties", path)
    return elements


def _refused(what: str, path: Path) -> ScanError:
    return ScanError(f"{path}, a PLY file of {what}", _FORMAT, "download it again, or convert it")
