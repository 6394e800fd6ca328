"""Named columns, as PCD, PLY and NumPy files hold them ⇄ :class:`Scan`."""

import math
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Set
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Num
from torch import Tensor

from lidargrit.core.errors import OutputError, ScanError
from lidargrit.data.formats import BadPoints, ScanFormat, damaged, first_bytes, scan_of
from lidargrit.data.formats.shared.labels import notes_on_labels
from lidargrit.data.formats.shared.reflectance import REFLECTANCE_NAMES, choose_reflectance, floats
from lidargrit.scans.file_rows import FileRows
from lidargrit.scans.types import Scan

BYTES_AT_MOST = 256_000_000  # 4 million points of 64 bytes; sensors' own files have up to 48 a point
REFLECTANCE_RULE = "0 to 1, 0 to 255 or 0 to 65535: the smallest of these that holds all values of a file; 8 bits: 255"

_RING = ("ring", "channel")  # lower case; CloudCompare puts "scalar_" before its names
_LABEL = ("label",)
_FILLED = ("filled",)
_TIME = ("time", "time_s", "timestamp", "time_stamp", "timestamps", "offset_time", "time_offset", "t")  # kept in files
_ALIKE = re.compile("intens|reflect|remission|scalar.?field|laser|ring|channel|beam|layer")  # of names, not values
_NO_NUMBER = re.compile(rb"[-+]?(?:nan\([a-z0-9_]{0,20}\)|1\.?#(?:qnan|snan|ind|inf)[0-9]{0,20})", re.IGNORECASE)
_LASERS = (16, 32, 40, 64, 80, 128, 256)  # that sensors have; the top ring may have no return, and not be in the file
_ONE_RING_AT_MOST_RAD = math.radians(5)  # that the elevations of a sensor with one ring may span
_LOST_AT_MOST_M = 0.5e-3  # of coordinates, in the median: that of points beyond 16 km
_LINE_BYTES_AT_MOST = 65_536  # of text; real ones take up to some hundreds
_RING_AT_MOST = 65_535  # 16 bits, as ROS drivers store it
_LABEL_AT_MOST = 2**32 - 1  # SemanticKITTI's: class and instance in 16 bits each


class ColumnFormat(ScanFormat):
    """A format of named columns, which keeps all that a scan has of intensity, ring, label and filled points."""

    reflectance = REFLECTANCE_RULE
    keeps = ("reflectance", "ring", "label")

    @classmethod
    def columns_of(cls, scan: Scan) -> dict[str, np.ndarray]:
        """Return coordinates, and what the scan has of intensity, ring, label and filled."""
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
    """Make a scan of columns that are known by their names; others are left alone.

    Reflectance is divided by 1, 255 or 65535: the smallest that no value exceeds, and 255 for columns of 8 bits. It is
    left out, with a note, where it is none: of negative values or counts above 65535. Rings are counted from the top:
    where the file's rise with elevation, they are turned round. A ring that all points have is none.

    Args:
        columns: values of every point by their names.
        others: names of columns that were not read.
        are_named: whether the file itself has the names; where it has not, reflectance that is none shows another
            layout, and is refused.
    """
    named = {_plain(name): values for name, values in reversed(list(columns.items()))}
    if not {"x", "y", "z"} <= named.keys():
        there = ", ".join(map(ascii, list(columns)[:8])) or "none"
        raise ScanError(f"{path}, whose columns are {there[:120]}", "x, y and z among them", "rename its columns")
    points_xyz_m = torch.stack([floats(named[axis]) for axis in "xyz"], dim=1)
    _refuse_lost_digits([named[axis] for axis in "xyz"], points_xyz_m, path)
    ring, label = (_first(named, names) for names in (_RING, _LABEL))
    good = points_xyz_m.isfinite().all(dim=1) & (points_xyz_m != 0).any(dim=1)
    if ring is not None and _tells_rows(ring, points_xyz_m, good):
        ring = _whole(ring, good, _RING_AT_MOST, "ring", path)
        _refuse_counts_from_1(ring[good], path)
        ring = _from_the_top(ring, points_xyz_m, good)
    else:
        ring = None
    reflectance, full_scale, notes = choose_reflectance(named, good, are_named)
    notes += _left_alone({*named, *map(_plain, others)})
    label = None if label is None else _whole(label, good, _LABEL_AT_MOST, "label", path)
    notes += notes_on_labels(label)
    marks = _first(named, _FILLED)
    filled = torch.from_numpy(marks == 1) if marks is not None and np.isin(marks, (0, 1)).all() else None
    rows = FileRows(columns, np.arange(len(points_xyz_m)))
    return scan_of(
        points_xyz_m, reflectance, ring, str(path), bad_points, label, full_scale, notes, filled=filled, rows=rows
    )


def known_name(name: str) -> str:
    """Return the plain name of a column besides x, y and z that a scan has room for; "" if it has none."""
    return _plain(name) if _plain(name) in (*REFLECTANCE_NAMES, *_RING, *_LABEL, *_FILLED, *_TIME) else ""


def quantity_of(name: str) -> str:
    """Return what a column holds of a scan: x, y, z, reflectance, ring, label or filled; "" for something else."""
    plain = _plain(name)
    kinds = {"reflectance": REFLECTANCE_NAMES, "ring": _RING, "label": _LABEL, "filled": _FILLED}
    return plain if plain in ("x", "y", "z") else next((kind for kind, names in kinds.items() if plain in names), "")


def columns_of(scan: Scan) -> dict[str, np.ndarray]:
    """Return a scan's columns for a file: x, y, z and what it has of intensity, ring, label and filled."""
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
    return columns


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


def _plain(name: str) -> str:
    return name.lower().removeprefix("scalar_")


def _refuse_lost_digits(exact: list[np.ndarray], points_xyz_m: Tensor, path: Path) -> None:
    """Refuse coordinates that 32 bits do not keep, those of maps: every verb would move the points."""
    if all(values.dtype.itemsize <= 4 for values in exact) or not len(points_xyz_m):
        return
    with np.errstate(over="ignore", invalid="ignore"):
        kept = points_xyz_m.double().numpy()
        lost_m = np.abs(np.stack(exact, axis=1).astype(np.float64) - kept).max(axis=1)
    lost_m = lost_m[np.isfinite(lost_m)]
    if not len(lost_m) or (typical_m := float(np.median(lost_m))) <= _LOST_AT_MOST_M:
        return
    far_km = float(np.median(np.linalg.norm(kept[np.isfinite(kept).all(axis=1)], axis=1))) / 1000
    raise ScanError(
        f"coordinates of a map in {path} ({far_km:,.0f} km from the origin), which would move by {typical_m:.3f} m in "
        f"the median and {lost_m.max():.3f} m at most in the 32 bits that scans are kept in",
        "those of a sensor, seen from its place",
        "subtract the sensor's place from x, y and z",
    )


def _left_alone(named: Set[str]) -> tuple[str, ...]:
    """Return a note on columns that are left alone although a scan lacks what they may be."""
    missing = [name for name, names in (("intensity", REFLECTANCE_NAMES), ("ring", _RING)) if not named & {*names}]
    alike = [name for name in sorted(named) if not known_name(name) and _ALIKE.search(name)]
    if not missing or not alike:
        return ()
    what = f"{'a column' if len(alike) == 1 else 'columns'} {', '.join(map(ascii, alike[:3]))} left alone"
    return (f"{what}; rename what is {' or '.join(missing)} to that",)


def _first(named: Mapping[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray | None:
    return next((named[name] for name in names if name in named), None)


def _whole(values: np.ndarray, good: Tensor, at_most: int, what: str, path: Path) -> Tensor:
    """Return whole numbers, 0 where the point is none."""
    values = np.where(good.numpy(), values, 0)
    # NaN and infinity equal no whole number, and the limits may be infinite as half precision.
    with np.errstate(over="ignore", invalid="ignore"):
        whole = bool(((values >= 0) & (values <= at_most) & (values % 1 == 0)).all())
    if not whole:
        raise ScanError(
            f"a {what} that is not whole or out of bounds in {path}", f"0 to {at_most:,}", "correct the file"
        )
    return torch.from_numpy(values.astype(np.int64))


def _tells_rows(ring: np.ndarray, points_xyz_m: Tensor, good: Tensor) -> bool:
    """Return whether a column of rings tells points apart: some drivers write 0 for all."""
    if not good.any() or (ring != ring.flat[0]).any():
        return True
    low, high = _elevation_rad(points_xyz_m[good]).aminmax()
    return float(high - low) < _ONE_RING_AT_MOST_RAD


def _refuse_counts_from_1(ring: Tensor, path: Path) -> None:
    """Refuse rings from 1 to the number of lasers that a sensor has; in rows counted from 0 each would be off by 1."""
    if len(ring) and 1 <= int(ring.min()) < int(ring.max()) and int(ring.max()) in _LASERS:
        raise ScanError(
            f"rings from {int(ring.min())} to {int(ring.max())} in {path}, as if they were counted from 1",
            "rings counted from 0",
            "subtract 1 from each, or leave the column out",
        )


def _from_the_top(ring: Tensor, points_xyz_m: Tensor, good: Tensor) -> Tensor:
    """Return rings counted from the highest, whichever way round the file counts them."""
    centred = ring[good].double() - ring[good].double().mean()
    if not bool((centred * _elevation_rad(points_xyz_m[good])).sum() > 0):
        return ring
    highest = int(ring.max())
    lasers = next((count for count in _LASERS if highest < count), highest + 1)
    return torch.where(good, lasers - 1 - ring, 0)


def _elevation_rad(points_xyz_m: Tensor) -> Tensor:
    x, y, z = points_xyz_m.double().unbind(dim=1)
    return torch.atan2(z, torch.hypot(x, y))
