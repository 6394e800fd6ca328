"""Arrays of a scan, one with rows of points and others beside it, as NumPy and HDF5 files hold them → columns."""

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from lidargrit.core.arrays import HEADER_BYTES_AT_MOST, member_header, read_member
from lidargrit.core.errors import ScanError
from lidargrit.data.formats import POINTS_AT_MOST
from lidargrit.data.formats.shared.columns import BYTES_AT_MOST
from lidargrit.scans.columns import known_name

POINTS = ("points", "xyz", "points_xyz_m")
"""What an array of points is called, in the order in which names count."""
WIDTHS = range(3, 6)
"""How many numbers rows of points have."""
ROWS = ("x", "y", "z", "intensity", "ring")
"""What these numbers are."""
_IMAGE = "range_m"  # of samples, which lie in a folder with what tells their rays
_VALUE_BYTES_AT_MOST = 16  # numpy's widest number
_POINTS_FOR_RINGS, _RINGS_AT_MOST = 100, 256
_ROWS_AT_LEAST = 16  # of an array that is not called points: matrices of cameras and poses have fewer
_WITHIN_RINGS = 0.05  # share of the elevations' variance; reflectance of whole numbers leaves nearly all of it


def has_points(archive: zipfile.ZipFile) -> bool:
    """Return whether an archive has points: an array called so, x, y and z, or one that is no column and looks so.

    Raises:
        ValueError: that one array is damaged.
    """
    members = _members(archive)
    return _has_axes(members) or (_IMAGE not in members and bool(_points_name(archive, members)))


def columns_of_archive(archive: zipfile.ZipFile, path: Path, wanted: str) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the columns of the points in an archive, and the names of all its arrays.

    Args:
        wanted: description of a good file, for messages.
    """
    members = _members(archive)
    there, points_name, columns = [*members], _points_name(archive, members), dict[str, np.ndarray]()
    if not _has_axes(members) and (_IMAGE in members or not points_name):
        if _IMAGE in members:
            got, cure = "a range image from a folder of samples", f"name the whole folder: {path.absolute().parent}"
        else:
            got = f"which holds {'the arrays ' + ', '.join(map(ascii, there[:8]))[:120] if there else 'no array'}"
            cure = "call the array of points 'points'"
        raise ScanError(f"{path}, {got}", wanted, cure)
    if points_name:
        rows = read_member(archive, members.pop(points_name), BYTES_AT_MOST, may_have_fields=True)
        columns = columns_of_rows(rows, path, wanted)
    else:
        for axis in "xyz":
            name = axis if axis in members else axis.upper()
            columns[axis] = read_member(archive, members.pop(name), BYTES_AT_MOST).reshape(-1)
    count = len(next(iter(columns.values()), ()))
    at_most = _VALUE_BYTES_AT_MOST * count + HEADER_BYTES_AT_MOST
    for member, info in members.items():
        name = known_name(member)
        # What else is in the archive is not unpacked, nor the same name again: with other capitals there are hundreds.
        if name and name not in columns:
            columns[name] = read_member(archive, info, at_most)
    for name, values in columns.items():
        if values.dtype.kind == "b":
            raise _refused(f"truth values as {name}", path, wanted)
        if values.size == count:  # such as (n, 1), or organised as the points are
            columns[name] = values.reshape(-1)
        if columns[name].shape != (count,):
            raise _refused(f"{count} points, but {name} of shape {values.shape}", path, wanted)
    return columns, there


def columns_of_rows(rows: np.ndarray, path: Path, wanted: str) -> dict[str, np.ndarray]:
    """Return the columns of an array: rows of named numbers, or of 3 to 5; organised (H, W, 3), or by column (3, n).

    Args:
        wanted: description of a good file, for messages.
    """
    if rows.size > len(ROWS) * POINTS_AT_MOST:
        raise _refused(f"an array of shape {rows.shape}", path, wanted, "give one revolution a file")
    if rows.dtype.names:
        return {
            name: np.ascontiguousarray(rows[name]).reshape(-1)
            for name in rows.dtype.names
            if not rows.dtype[name].shape
        }
    if rows.dtype.kind == "b":
        raise _refused("truth values as points", path, wanted)
    if rows.ndim == 2 and rows.shape[0] in WIDTHS and rows.shape[1] not in WIDTHS:
        rows = rows.T
    if rows.ndim not in (2, 3) or rows.shape[-1] not in WIDTHS or rows[..., 0].size > POINTS_AT_MOST:
        cure = "shape it into rows, such as array.view(np.float32).reshape(-1, 4)" if rows.ndim == 1 else ""
        raise _refused(f"an array of shape {rows.shape}", path, wanted, cure or f"keep {', '.join(ROWS)} of each point")
    columns = rows.reshape(-1, rows.shape[-1]).T
    names = ("x", "y", "z", "ring") if len(columns) == 4 and _are_rings(columns) else ROWS
    return dict(zip(names, columns, strict=False))


def _members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    return {info.filename.removesuffix(".npy"): info for info in archive.infolist()}


def _has_axes(members: Mapping[str, zipfile.ZipInfo]) -> bool:
    return {*"xyz"} <= {name.lower() for name in members}


def _points_name(archive: zipfile.ZipFile, members: Mapping[str, zipfile.ZipInfo]) -> str:
    """Return the array of points: by its name, else the only one that is no column, if it has rows of points."""
    others = [name for name in members if not known_name(name)]
    named = next((name for name in POINTS if name in members), "")
    if named or len(others) != 1:
        return named
    shape, dtype = member_header(archive, members[others[0]])
    if dtype.names:
        return others[0] if {*"xyz"} <= {name.lower() for name in dtype.names} else ""
    rows = len(shape) == 2 and dtype.kind in "fiu" and bool({*shape} & {*WIDTHS})
    return others[0] if rows and max(shape) >= _ROWS_AT_LEAST else ""


def _are_rings(columns: np.ndarray) -> bool:
    """Return whether a fourth column without a name numbers lasers: few whole numbers, each at one elevation."""
    x, y, z, number = columns.astype(np.float64)  # in 32 bits, squares of huge numbers overflow
    if len(number) < _POINTS_FOR_RINGS or not np.isfinite(columns).all():
        return False
    values, of_point = np.unique(number, return_inverse=True)
    if not (4 <= len(values) <= _RINGS_AT_MOST and values[0] >= 0 and values[-1] < _RINGS_AT_MOST):
        return False
    elevation = np.arctan2(z, np.hypot(x, y))
    mean = np.bincount(of_point, elevation) / np.bincount(of_point)
    return bool((values % 1 == 0).all()) and float(
        np.square(elevation - mean[of_point]).mean()
    ) < _WITHIN_RINGS * float(elevation.var())


def _refused(what: str, path: Path, wanted: str, cure: str = "save the points anew") -> ScanError:
    return ScanError(f"{path}, which holds {what}", wanted, cure)
