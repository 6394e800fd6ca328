"""Named columns, as PCD, PLY and NumPy files hold them ⇄ :class:`Scan`."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Num
from torch import Tensor

from lidargrit.core.errors import OutputError, ScanError
from lidargrit.data.formats import BadPoints, damaged, scan_of
from lidargrit.scans.types import Scan

BYTES_AT_MOST = 256_000_000  # 4 million points of 64 bytes; sensors' own files have up to 48 a point
REFLECTANCE_RULE = "0 to 1, 0 to 255 or 0 to 65535: the smallest of these that holds all values of a file; 8 bits: 255"

# Lower case; CloudCompare puts "scalar_" before its names. Where a file has several, the first counts: reflectivity is
# calibrated where intensity is not (Ouster).
_REFLECTANCE = ("reflectance", "reflectivity", "intensity", "remission", "i")
_RING = ("ring", "channel")
_LABEL = ("label",)
_FULL_SCALES = (1, 255, 65_535)
_ABOUT_1 = 1.05  # of reflectance from 0 to 1 that a calibration took a little beyond
_LASERS = (16, 32, 40, 64, 80, 128, 256)  # that sensors have; the top ring may have no return, and not be in the file
_ONE_RING_AT_MOST_RAD = math.radians(5)  # that the elevations of a sensor with one ring may span
_LINE_BYTES_AT_MOST = 65_536  # of text; real ones take up to some hundreds
_RING_AT_MOST = 65_535  # 16 bits, as ROS drivers store it
_LABEL_AT_MOST = 2**32 - 1  # SemanticKITTI's: class and instance in 16 bits each


def scan_of_columns(columns: Mapping[str, Num[np.ndarray, "n"]], path: Path, bad_points: BadPoints) -> Scan:
    """Make a scan of columns that are known by their names; others are left alone.

    Reflectance is divided by 1, 255 or 65535: the smallest that no value exceeds, and 255 for columns of 8 bits. Rings
    are counted from the top: where the file's rise with elevation, they are turned round. A ring that all points have
    is none.

    Raises:
        ScanError: x, y or z is not there, rings or labels are not whole numbers, rings are counted from 1, or the
            points are unfit.
    """
    named = {_plain(name): values for name, values in reversed(list(columns.items()))}
    if not {"x", "y", "z"} <= named.keys():
        there = ", ".join(map(ascii, list(columns)[:8])) or "none"
        raise ScanError(f"{path}, whose columns are {there[:120]}", "x, y and z among them", "rename its columns")
    points_xyz_m = torch.stack([_floats(named[axis]) for axis in "xyz"], dim=1)
    reflectance, ring, label = (_first(named, names) for names in (_REFLECTANCE, _RING, _LABEL))
    good = points_xyz_m.isfinite().all(dim=1) & (points_xyz_m != 0).any(dim=1)
    if ring is not None and _tells_rows(ring, points_xyz_m, good):
        ring = _whole(ring, good, _RING_AT_MOST, "ring", path)
        _refuse_counts_from_1(ring[good], path)
        ring = _from_the_top(ring, points_xyz_m, good)
    else:
        ring = None
    in_unit, full_scale = (None, 0) if reflectance is None else _to_unit(reflectance)
    label = None if label is None else _whole(label, good, _LABEL_AT_MOST, "label", path)
    return scan_of(points_xyz_m, in_unit, ring, str(path), bad_points, label, full_scale)


def known_name(name: str) -> str:
    """Return the plain name of a column besides x, y and z that a scan has room for; "" if it has none."""
    return _plain(name) if _plain(name) in (*_REFLECTANCE, *_RING, *_LABEL) else ""


def columns_of(scan: Scan) -> dict[str, np.ndarray]:
    """Return a scan's columns for a file: x, y, z and what it has of intensity, ring and label."""
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
    return columns


def check_lines(data: bytes, path: Path, wanted: str) -> None:
    """Refuse text with a line longer than any of numbers: NumPy takes twenty times the memory of a line.

    Raises:
        ScanError: such a line.
    """
    start = 0
    while len(data) - start > _LINE_BYTES_AT_MOST:
        start = data.rfind(b"\n", start, start + _LINE_BYTES_AT_MOST) + 1
        if not start:
            what = f"a line of more than {_LINE_BYTES_AT_MOST:,} bytes in {path}"
            raise ScanError(what, wanted, "give every point a line of its own")


def text_rows(data: bytes, rows: int, names: list[str], path: Path, wanted: str) -> dict[str, np.ndarray]:
    """Read rows of numbers between blanks.

    Raises:
        ScanError: fewer rows, other columns, or no numbers.
    """
    promised = f"the {rows} rows of {len(names)} numbers that its header says"
    if 2 * rows * len(names) > len(data) + 1:  # a number takes a digit and a blank; room is made for all rows at once
        raise ScanError(f"{len(data)} bytes of text in {path}", promised, "download it again: the file was cut short")
    check_lines(data, path, promised)
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


def _first(named: Mapping[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray | None:
    return next((named[name] for name in names if name in named), None)


def _floats(values: np.ndarray) -> Tensor:
    # A double beyond float32 becomes infinite, and is refused as such.
    with np.errstate(over="ignore", invalid="ignore"):
        return torch.from_numpy(values.astype(np.float32))


def _to_unit(reflectance: np.ndarray) -> tuple[Tensor, int]:
    """Return reflectance from 0 to 1, and its full scale if the largest value told that; 0 otherwise."""
    values = _floats(reflectance)
    if reflectance.dtype == np.uint8:
        return values / 255, 0
    highest = float(values.nan_to_num(0.0, torch.inf, 0.0).max()) if len(values) else 0.0
    if highest <= 0:  # of any scale
        return values, 0
    if highest <= _ABOUT_1:
        return values.clamp(max=1), 1
    full_scale = next((scale for scale in _FULL_SCALES if highest <= scale), 1)
    return values / full_scale, full_scale


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
