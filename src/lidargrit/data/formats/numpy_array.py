"""NumPy's .npz of named arrays, or .npy of rows x, y, z, reflectance, ring ⇄ :class:`Scan`."""

import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BufferedReader, BytesIO
from pathlib import Path

import numpy as np

from lidargrit.core.arrays import HEADER_BYTES_AT_MOST, open_archive, parse_array, read_member
from lidargrit.core.errors import ScanError
from lidargrit.core.files import atomic_path
from lidargrit.data.formats import POINTS_AT_MOST, BadPoints, damaged, first_bytes, open_file, read_bytes
from lidargrit.data.formats.shared.carla import right_handed
from lidargrit.data.formats.shared.columns import BYTES_AT_MOST, ColumnFormat, scan_of_columns
from lidargrit.data.formats.shared.filled import marks_file, read_marks, write_marks
from lidargrit.scans.columns import known_name
from lidargrit.scans.types import Scan

_FORMAT = "an .npy of n rows of 3 to 5 numbers or of named ones, or an .npz with an array points of n rows"
_MAGIC = b"\x93NUMPY"  # of an array alone
_VALUE_BYTES_AT_MOST = 16  # numpy's widest number
_ROWS = ("x", "y", "z", "intensity", "ring")
_WIDTHS = range(3, 6)
_POINTS_FOR_RINGS, _RINGS_AT_MOST = 100, 256
_WITHIN_RINGS = 0.05  # share of the elevations' variance; reflectance of whole numbers leaves nearly all of it
_UNNAMED = "arr_0"  # as numpy calls an array that is saved without a name
_POINTS = ("points", "xyz", "points_xyz_m")


class NumpyArray(ColumnFormat):
    """Arrays as numpy saves them; objects, which are code, are never loaded.

    An ``.npy`` holds a row of x, y, z for every point, and reflectance and ring if the rows are longer; a fourth number
    that keeps to one elevation is the ring. Rows of named numbers, organised clouds (H, W, 3) and arrays by column
    (3, n) are taken, too. An ``.npz`` holds such rows as ``points`` (or xyz), or as its one array without a name, and
    if they are there reflectance (or reflectivity, intensity, remission,
    i), ring (or channel) and label as arrays of their own. The ``.npy`` of a scan with rings but without reflectance
    is given a reflectance of 0.
    """

    title = "NumPy array (.npz, .npy)"
    suffixes = (".npz", ".npy")

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether a file is an array, or an archive with an array of points."""
        if first_bytes(path, 6) == _MAGIC:
            return True
        try:
            with open_file(path, _FORMAT) as file, _archive(file, path) as archive:
                names = set(archive.namelist())
                return bool({f"{name}.npy" for name in _POINTS} & names) or names == {f"{_UNNAMED}.npy"}
        except (ScanError, OSError):
            return False

    @staticmethod
    def read(path: Path, index: int = 0, bad_points: BadPoints = "refuse") -> Scan:
        """Read the scan in a file."""
        data = read_bytes(path, BYTES_AT_MOST, _FORMAT)
        names: list[str] = []
        if data.startswith(_MAGIC):
            try:
                rows = parse_array(data, may_have_fields=True)
            except ValueError as error:
                raise damaged(path, _FORMAT, error) from None
            columns, names = _row_columns(rows, path), list(rows.dtype.names or ())
            if (marks := read_marks(path, len(next(iter(columns.values()), ())))) is not None:
                columns["filled"] = marks.numpy().astype(np.uint8)
        else:
            with _archive(BytesIO(data), path) as archive:
                columns, names = (
                    _archive_columns(archive, path),
                    [one.removesuffix(".npy") for one in archive.namelist()],
                )
        return right_handed(scan_of_columns(columns, path, bad_points, names, are_named=bool(names)), columns)

    @staticmethod
    def companions(path: Path) -> tuple[Path, ...]:
        """Return the marks of filled points beside an ``.npy``; an ``.npz`` holds them itself."""
        return (marks_file(path),) if path.suffix.lower() == ".npy" else ()

    @classmethod
    def write_columns(cls, path: Path, columns: Mapping[str, np.ndarray]) -> None:
        """Write columns to a new file, an ``.npy`` if the path ends so, which holds x, y, z, intensity and ring."""
        columns = dict(columns)
        points = np.stack([columns.pop(axis) for axis in "xyz"], axis=1)
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            if path.suffix.lower() != ".npy":
                np.savez(file, points=points, **columns)  # pyright: ignore[reportArgumentType]  it fears a column "allow_pickle"
                return
            if "ring" in columns:
                columns.setdefault("intensity", np.zeros(len(points), dtype=np.float32))
            write_marks(path, columns.get("filled"))
            np.save(file, np.column_stack([points, *(columns[name] for name in _ROWS[3:] if name in columns)]))


def holds_points(path: Path) -> bool:
    """Return whether the header of an ``.npy`` is of points: rows of named numbers, or 3 to 5 numbers in each."""
    file = BytesIO(first_bytes(path, 2 * HEADER_BYTES_AT_MOST))
    try:
        read = np.lib.format.read_array_header_1_0
        if np.lib.format.read_magic(file) != (1, 0):
            read = np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file, max_header_size=HEADER_BYTES_AT_MOST)
    except Exception:  # told where it is read
        return True
    if dtype.names:
        return {*"xyz"} <= {name.lower() for name in dtype.names}
    return dtype.kind in "fiu" and len(shape) in (2, 3) and bool({shape[0], shape[-1]} & {*_WIDTHS})


def _row_columns(rows: np.ndarray, path: Path) -> dict[str, np.ndarray]:
    """Return the columns of an array: rows of named numbers, or of 3 to 5; organised (H, W, 3), or by column (3, n)."""
    if rows.size > len(_ROWS) * POINTS_AT_MOST:
        raise _refused(f"an array of shape {rows.shape}", path)
    if rows.dtype.names:
        return {
            name: np.ascontiguousarray(rows[name]).reshape(-1)
            for name in rows.dtype.names
            if not rows.dtype[name].shape
        }
    if rows.dtype.kind == "b":
        raise _refused("truth values as points", path)
    if rows.ndim == 2 and rows.shape[0] in _WIDTHS and rows.shape[1] not in _WIDTHS:
        rows = rows.T
    if rows.ndim not in (2, 3) or rows.shape[-1] not in _WIDTHS or rows[..., 0].size > POINTS_AT_MOST:
        raise _refused(f"an array of shape {rows.shape}", path)
    columns = rows.reshape(-1, rows.shape[-1]).T
    names = ("x", "y", "z", "ring") if len(columns) == 4 and _are_rings(columns) else _ROWS
    return dict(zip(names, columns, strict=False))


def _are_rings(columns: np.ndarray) -> bool:
    """Return whether a fourth column without a name numbers lasers: few whole numbers, each at one elevation."""
    x, y, z, number = columns
    if len(number) < _POINTS_FOR_RINGS or not np.isfinite(columns).all():
        return False
    values, of_point = np.unique(number, return_inverse=True)
    if not (4 <= len(values) <= _RINGS_AT_MOST and values[0] >= 0 and values[-1] < _RINGS_AT_MOST):
        return False
    elevation = np.arctan2(z.astype(np.float64), np.hypot(x, y))
    mean = np.bincount(of_point, elevation) / np.bincount(of_point)
    return bool((values % 1 == 0).all()) and float(
        np.square(elevation - mean[of_point]).mean()
    ) < _WITHIN_RINGS * float(elevation.var())


def _archive_columns(archive: zipfile.ZipFile, path: Path) -> dict[str, np.ndarray]:
    members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
    points_name = next((name for name in _POINTS if name in members), None)
    if list(members) == [_UNNAMED]:
        points_name = _UNNAMED
    if points_name is None and "range_m" in members:
        raise ScanError(
            f"{path}, a range image from a folder of samples",
            _FORMAT,
            f"name the whole folder: {path.absolute().parent}",
        )
    if points_name is None:
        raise _refused(f"the arrays {', '.join(map(ascii, list(members)[:8]))[:120]}", path)
    rows = read_member(archive, members.pop(points_name), BYTES_AT_MOST, may_have_fields=True)
    columns = _row_columns(rows, path)
    count = len(next(iter(columns.values()), ()))
    at_most = _VALUE_BYTES_AT_MOST * count + HEADER_BYTES_AT_MOST
    for member, info in members.items():
        name = known_name(member)
        # What else is in the archive is not unpacked, nor the same name again: with other capitals there are hundreds.
        if not name or name in columns:
            continue
        columns[name] = read_member(archive, info, at_most)
        if columns[name].dtype.kind == "b":
            raise _refused(f"truth values as {name}", path)
        if columns[name].size == count:  # such as (n, 1), or organised as the points are
            columns[name] = columns[name].reshape(-1)
        if columns[name].shape != (count,):
            raise _refused(f"{count} points, but {name} of shape {columns[name].shape}", path)
    return columns


@contextmanager
def _archive(file: BytesIO | BufferedReader, path: Path) -> Iterator[zipfile.ZipFile]:
    """Open an archive, or say in one line what is wrong with it or with an array that is read from it."""
    try:
        with open_archive(file) as archive:
            yield archive
    except ScanError:
        raise
    except ValueError as error:
        raise damaged(path, _FORMAT, error) from None


def _refused(what: str, path: Path) -> ScanError:
    return ScanError(f"{path}, which holds {what}", _FORMAT, "save the points anew, or remove the file")
