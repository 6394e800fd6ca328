"""PCD files of the Point Cloud Library, text, binary or compressed ⇄ :class:`Scan`."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import lzf
import numpy as np

from lidargrit.core.errors import ScanError
from lidargrit.core.files import atomic_path
from lidargrit.data.formats import POINTS_AT_MOST, BadPoints, damaged, read_bytes
from lidargrit.data.formats.shared.columns import (
    BYTES_AT_MOST,
    ColumnFormat,
    begins_as,
    in_one_word,
    little_endian,
    scan_of_columns,
    text_rows,
    whole_number,
)
from lidargrit.scans.types import Scan

_FORMAT = "a PCD file with the fields x, y and z"
_HEADER_BYTES_AT_MOST = 65_536  # real ones take 200 to 500
_ROW_BYTES_AT_MOST = 4096  # real ones take 12 to 48; histograms of features up to 1 kB
_SIZES = {"F": (4, 8), "U": (1, 2, 4, 8), "I": (1, 2, 4, 8)}
_KINDS = [f"{kind.lower()}{size}" for kind, sizes in _SIZES.items() for size in sizes]


class Pcd(ColumnFormat):
    """Point Cloud Data, version 0.7 and its forerunners; ordered clouds too, whose placeholders are NaN.

    Fields are found by their names: x, y, z, and if they are there reflectance (or reflectivity, intensity,
    remission, i), ring (or channel) and label. The viewpoint is left alone. Written files are binary.

    Source:
        https://pointclouds.org/documentation/tutorials/pcd_file_format.html
    """

    title = "PCD (Point Cloud Library)"
    suffixes = (".pcd",)

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether a file begins with a header of PCD."""
        return begins_as(path, _HEADER_BYTES_AT_MOST, _Header.parse)

    @staticmethod
    def read(path: Path, index: int = 0, bad_points: BadPoints = "refuse") -> Scan:
        """Read the scan in a file."""
        data = read_bytes(path, BYTES_AT_MOST, _FORMAT)
        header = _Header.parse(data, path)
        body = data[header.end :]
        if header.data == "ascii":
            columns = text_rows(body, header.points, header.column_names(), path, _FORMAT)
        else:
            columns = _binary(header, body, path)
        return scan_of_columns(
            {field: columns[name] for field, name in header.single_fields().items()}, path, bad_points
        )

    @classmethod
    def write_columns(cls, path: Path, columns: Mapping[str, np.ndarray]) -> None:
        """Write columns to a new binary file."""
        columns = {name: little_endian(values, _KINDS) for name, values in in_one_word(columns).items()}
        rows = np.rec.fromarrays(list(columns.values()), [(name, values.dtype) for name, values in columns.items()])
        lines = {
            "VERSION": "0.7",
            "FIELDS": " ".join(columns),
            "SIZE": " ".join(f"{values.dtype.itemsize}" for values in columns.values()),
            "TYPE": " ".join(values.dtype.kind.upper() for values in columns.values()),
            "COUNT": " ".join("1" for _ in columns),
            "WIDTH": f"{len(rows)}",
            "HEIGHT": "1",
            "VIEWPOINT": "0.0 0.0 0.0 1.0 0.0 0.0 0.0",
            "POINTS": f"{len(rows)}",
            "DATA": "binary",
        }
        header = "".join(f"{key} {words}\n" for key, words in lines.items())
        with atomic_path(path) as temporary:
            temporary.write_bytes(header.encode() + rows.tobytes())


@dataclass(frozen=True)
class _Header:
    """What the first lines of a file say, after it has been checked: nothing in it asks for more than the file has."""

    fields: tuple[str, ...]
    sizes: tuple[int, ...]
    types: tuple[str, ...]
    counts: tuple[int, ...]
    points: int
    data: str
    end: int

    @classmethod
    def parse(cls, data: bytes, path: Path) -> "_Header":
        words, end = _entries(data, path)
        fields, types = words.get("FIELDS", words.get("COLUMNS", ())), [one.upper() for one in words.get("TYPE", ())]
        sizes = tuple(map(whole_number, words.get("SIZE", ())))
        counts = tuple(map(whole_number, words["COUNT"])) if "COUNT" in words else (1,) * len(fields)
        points = _points(words, path)
        if not len(fields) == len(types) == len(sizes) == len(counts) > 0:
            raise _refused(f"{len(fields)} fields, {len(sizes)} sizes, {len(types)} types, {len(counts)} counts", path)
        if unknown := [(t, s) for t, s in zip(types, sizes, strict=True) if s not in _SIZES.get(t, ())]:
            raise _refused(f"a field of type {unknown[0][0][:10]!r} and size {unknown[0][1]}", path)
        row_bytes = sum(size * count for size, count in zip(sizes, counts, strict=True))
        if min(counts) < 0 or not 0 < row_bytes <= _ROW_BYTES_AT_MOST:
            raise _refused(f"counts from {min(counts)} to {max(counts)} values a point", path)
        if row_bytes * points > BYTES_AT_MOST:
            raise _refused(f"{points} points of {row_bytes} bytes", path)
        # A field of no values takes no room: padding, as some programs write it.
        kept = [row for row in zip(fields, sizes, types, counts, strict=True) if row[-1]]
        fields, sizes, types, counts = (tuple(column) for column in zip(*kept, strict=True))
        return cls(fields, sizes, types, counts, points, "".join(words["DATA"]).lower(), end)

    @property
    def row_bytes(self) -> int:
        return sum(size * count for size, count in zip(self.sizes, self.counts, strict=True))

    def column_names(self) -> list[str]:
        """Name every value of a point: "f1", or "f1.0", "f1.1" where a field has several."""
        return [
            f"f{index}" if count == 1 else f"f{index}.{part}"
            for index, count in enumerate(self.counts)
            for part in range(count)
        ]

    def single_fields(self) -> dict[str, str]:
        """Return the column of every field that has one value a point; of fields of one name, that of the first."""
        columns: dict[str, str] = {}
        for index, (field, count) in enumerate(zip(self.fields, self.counts, strict=True)):
            if count == 1:
                columns.setdefault(field, f"f{index}")
        return columns


def _points(words: dict[str, list[str]], path: Path) -> int:
    """Return the number of points; PCL takes one row where no height is given, and some programs leave both at 0."""
    width, height = (
        whole_number("".join(words.get(key, default))) for key, default in (("WIDTH", ""), ("HEIGHT", "1"))
    )
    points = whole_number("".join(words["POINTS"])) if "POINTS" in words else width * height
    if width == 0 or "WIDTH" not in words:
        width, height = points, 1
    if not 0 < points <= POINTS_AT_MOST or min(width, height) < 0 or width * height != points:
        raise _refused(f"{points} points in {width} columns and {height} rows", path)
    return points


def _entries(data: bytes, path: Path) -> tuple[dict[str, list[str]], int]:
    """Return the words after every key of the header, and where the points begin."""
    words: dict[str, list[str]] = {}
    end = 0
    while "DATA" not in words:
        start, end = end, data.find(b"\n", end, _HEADER_BYTES_AT_MOST) + 1
        if not end:
            raise _refused("a header that does not end with DATA", path)
        key, *values = data[start:end].decode("latin1").split() or ["#"]
        if not key.startswith("#"):
            words[key.upper()] = values
    return words, end


def _binary(header: _Header, body: bytes, path: Path) -> dict[str, np.ndarray]:
    """Return the fields of one value, of rows or, where they are compressed, of one field after the other."""
    wanted_bytes, packed = header.row_bytes * header.points, header.data == "binary_compressed"
    if not (header.data == "binary" or (packed and len(body) >= 8)):
        raise _refused(f"{len(body)} bytes of DATA {header.data[:20]!r}", path)
    if packed:
        packed_bytes, unpacked_bytes = np.frombuffer(body, "<u4", 2).tolist()
        if packed_bytes > len(body) - 8 or unpacked_bytes != wanted_bytes:  # before room is made for them
            raise _refused(f"{len(body) - 8} of {packed_bytes} bytes, {unpacked_bytes} unpacked", path)
        try:
            body = lzf.decompress(body[8 : 8 + packed_bytes], wanted_bytes)
        except ValueError as error:
            raise damaged(path, _FORMAT, error) from None
    if len(body) < wanted_bytes:
        raise _refused(f"{len(body)} bytes of points instead of {wanted_bytes}", path)
    fields = [
        (f"f{index}", f"<{kind.lower()}{size}", (count,))
        for index, (kind, size, count) in enumerate(zip(header.types, header.sizes, header.counts, strict=True))
    ]
    if not packed:
        rows = np.frombuffer(body, np.dtype(fields), header.points)
        return {name: rows[name][:, 0] for name in header.single_fields().values()}
    ends = np.cumsum([header.points * size * count for size, count in zip(header.sizes, header.counts, strict=True)])
    starts = dict(zip([name for name, _, _ in fields], [0, *ends.tolist()], strict=False))
    kinds = {name: kind for name, kind, _ in fields}
    return {
        name: np.frombuffer(body, kinds[name], header.points, starts[name]) for name in header.single_fields().values()
    }


def _refused(what: str, path: Path) -> ScanError:
    return ScanError(f"{path}, a PCD file of {what}", _FORMAT, "download it again, or convert it")
