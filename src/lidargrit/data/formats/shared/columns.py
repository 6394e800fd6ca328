"""Named columns, as PCD, PLY and NumPy files hold them, also as text ⇄ :class:`Scan`."""

import re
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Num

from lidargrit.core.errors import OutputError, ScanError
from lidargrit.data.formats import BadPoints, ScanFormat, damaged, first_bytes
from lidargrit.scans.columns import parts_of_columns
from lidargrit.scans.types import Scan

BYTES_AT_MOST = 256_000_000  # 4 million points of 64 bytes; sensors' own files have up to 48 a point
REFLECTANCE_RULE = (
    "0 to 1, 0 to 255 or 0 to 65535: the smallest of these that holds all values of a file, 0 to 1 also where few do "
    "not fit among fractions; 8 bits: 255"
)

_NO_NUMBER = re.compile(rb"[-+]?(?:nan\([a-z0-9_]{0,20}\)|1\.?#(?:qnan|snan|ind|inf)[0-9]{0,20})", re.IGNORECASE)
_BETWEEN_NAMES = re.compile(r"[\s,;]+")
_LINE_BYTES_AT_MOST = 65_536  # of text; real ones take up to some hundreds
_WITHIN_A_SCAN_S = 2.0


class ColumnFormat(ScanFormat):
    """A format of named columns, which keeps all that a scan has of intensity, ring, label, filled points and times."""

    reflectance = REFLECTANCE_RULE
    keeps = ("reflectance", "ring", "label")

    @classmethod
    def columns_of(cls, scan: Scan) -> dict[str, np.ndarray]:
        """Return coordinates, and what the scan has of intensity, ring, label, filled and time."""
        return columns_of(scan)


def begins_as(path: Path, num_bytes: int, check: Callable[[bytes, Path], object]) -> bool:
    """Return whether the first bytes of a file are the header of a format, by what checks and refuses it."""
    try:
        check(first_bytes(path, num_bytes), path)
    except ScanError:
        return False
    return True


def scan_of_columns(
    columns: Mapping[str, Num[np.ndarray, "n"]],
    path: Path,
    bad_points: BadPoints,
    others: Iterable[str] = (),
    are_named: bool = True,
) -> Scan:
    """Make a scan of a file's columns; see :func:`~lidargrit.scans.columns.parts_of_columns`."""
    return Scan(**parts_of_columns(columns, str(path), bad_points, others, are_named), source=str(path))


def columns_of(scan: Scan) -> dict[str, np.ndarray]:
    """Return a scan's columns for a file: x, y, z and what it has of intensity, ring, label, filled and time."""
    columns = {axis: scan.points_xyz_m[:, column].numpy() for column, axis in enumerate("xyz")}
    if scan.reflectance is not None:
        columns["intensity"] = scan.reflectance.numpy()
    for name, values, kind in (("ring", scan.ring, "<u2"), ("label", scan.label, "<u4")):
        if values is None:
            continue
        if not 0 <= int(values.min()) <= int(values.max()) <= np.iinfo(kind).max:
            raise OutputError(
                f"{name}s from {int(values.min())} to {int(values.max())}", f"0 to {np.iinfo(kind).max}", "correct them"
            )
        columns[name] = values.numpy().astype(kind)
    if scan.filled is not None:
        columns["filled"] = scan.filled.numpy().astype(np.uint8)
    if scan.point_time_s is not None:
        times_s = scan.point_time_s.numpy()
        # Within a scan 32 bits keep less than a microsecond, as drivers write it; times of a clock take 64.
        columns["time"] = times_s.astype(np.float32 if np.abs(times_s).max() < _WITHIN_A_SCAN_S else np.float64)
    return columns


def in_one_word(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return columns by names that headers of text can hold: blanks and signs between names would make two of one."""
    renamed = dict[str, np.ndarray]()
    for name, values in columns.items():
        word = _BETWEEN_NAMES.sub("_", name) or "_"
        while word in renamed or (word != name and word in columns):
            word += "_"
        renamed[word] = values
    return renamed


def little_endian(values: np.ndarray, kinds: Collection[str]) -> np.ndarray:
    """Return numbers in a type that a format has and in that order: truth values in bytes, others that lack in doubles.

    Args:
        kinds: NumPy's names of the format's types, such as "f4".
    """
    kind = values.dtype.str[1:]
    return values.astype(f"<{kind if kind in kinds else 'u1' if kind == 'b1' else 'f8'}")


def plain_text(data: bytes) -> bytes:
    """Return text in which whatever else programs print for a number that is none is ``nan``.

    The runtime of Windows prints -nan(ind), 1.#QNAN or -1.#IND0000; Linux and macOS print nan(snan) at most.
    """
    return _NO_NUMBER.sub(b"nan", data) if b"(" in data or b"#" in data else data


def check_lines(data: bytes, path: Path, wanted: str) -> None:
    """Refuse text with a line longer than any of numbers: NumPy takes twenty times the memory of a line."""
    start = 0
    while len(data) - start > _LINE_BYTES_AT_MOST:
        start = data.rfind(b"\n", start, start + _LINE_BYTES_AT_MOST) + 1
        if not start:
            what = f"a line of more than {_LINE_BYTES_AT_MOST:,} bytes in {path}"
            raise ScanError(what, wanted, "give every point a line of its own")


def text_rows(data: bytes, rows: int, names: list[str], path: Path, wanted: str) -> dict[str, np.ndarray]:
    """Read rows of numbers between blanks."""
    promised = f"the {rows} rows of {len(names)} numbers that its header says"
    if 2 * rows * len(names) > len(data) + 1:  # a number takes a digit and a blank; room is made for all rows at once
        raise ScanError(f"{len(data)} bytes of text in {path}", promised, "download it again: the file was cut short")
    check_lines(data, path, promised)
    data = plain_text(data)
    try:
        with warnings.catch_warnings(action="ignore"):  # of empty lines: what is missing is seen below
            table = np.loadtxt(BytesIO(data), np.float64, comments=None, max_rows=rows, ndmin=2, encoding="latin1")
    except Exception as error:  # whatever the text makes the parser stumble over
        raise damaged(path, wanted, error) from None
    if table.shape != (rows, len(names)):
        raise ScanError(
            f"{table.shape[0]} rows of {table.shape[1]} numbers in {path}",
            promised,
            "download it again: the file was cut short",
        )
    return dict(zip(names, table.T, strict=True))


def whole_number(text: str) -> int:
    """Return a word of a header as a whole number, or -1."""
    return int(text) if len(text) <= 18 and text.isascii() and text.isdigit() else -1
