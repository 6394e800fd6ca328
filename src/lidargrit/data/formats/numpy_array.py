"""NumPy's .npz of named arrays, or .npy of rows x, y, z, reflectance, ring ⇄ :class:`Scan`."""

import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BufferedReader, BytesIO
from pathlib import Path

import numpy as np

from lidargrit.core.arrays import HEADER_BYTES_AT_MOST, NoNumbersError, open_archive, parse_array, parse_header
from lidargrit.core.errors import ScanError
from lidargrit.core.files import atomic_path
from lidargrit.data.formats import BadPoints, damaged, first_bytes, open_file, read_bytes
from lidargrit.data.formats.shared.archive import ROWS, WIDTHS, columns_of_archive, columns_of_rows, has_points
from lidargrit.data.formats.shared.carla import right_handed
from lidargrit.data.formats.shared.columns import BYTES_AT_MOST, ColumnFormat, scan_of_columns
from lidargrit.data.formats.shared.filled import marks_file, read_marks, write_marks
from lidargrit.scans.types import Scan

_FORMAT = "an .npy of n rows of 3 to 5 numbers or of named ones, or an .npz with an array points of n rows"
_OF_SAVEZ = ("file", "allow_pickle", "points")  # names that no further column can have there
_MAGIC = b"\x93NUMPY"  # of an array alone


class NumpyArray(ColumnFormat):
    """Arrays as numpy saves them; objects, which are code, are never loaded.

    An ``.npy`` holds a row of x, y, z for every point, and reflectance and ring if the rows are longer; a fourth number
    that keeps to one elevation is the ring. Rows of named numbers, organised clouds (H, W, 3) and arrays by column
    (3, n) are taken, too. An ``.npz`` holds such rows as ``points`` (or xyz), or as x, y and z. It may also hold them
    as the one array whose name is no column of points, if it has at least 16 rows of 3 to 5 numbers. Reflectance (or
    reflectivity, intensity, remission, i), ring (or channel) and label lie beside them as arrays of their own. The
    ``.npy`` of a scan with rings but without reflectance is given a reflectance of 0.
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
                return has_points(archive)
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
                raise _unreadable(path, error) from None
            columns, names = columns_of_rows(rows, path, _FORMAT), list(rows.dtype.names or ())
            if (marks := read_marks(path, len(next(iter(columns.values()), ())))) is not None:
                columns["filled"] = marks.numpy().astype(np.uint8)
        else:
            with _archive(BytesIO(data), path) as archive:
                columns, names = columns_of_archive(archive, path, _FORMAT)
        return right_handed(scan_of_columns(columns, path, bad_points, names, are_named=bool(names)), columns)

    @staticmethod
    def sidecar_files(path: Path) -> tuple[Path, ...]:
        """Return the marks of filled points beside an ``.npy``; an ``.npz`` holds them itself."""
        return (marks_file(path),) if path.suffix.lower() == ".npy" else ()

    @classmethod
    def write_columns(cls, path: Path, columns: Mapping[str, np.ndarray]) -> None:
        """Write columns to a new file, an ``.npy`` if the path ends so, which holds x, y, z, intensity and ring."""
        columns = dict(columns)
        points = np.stack([columns.pop(axis) for axis in "xyz"], axis=1)
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            if path.suffix.lower() != ".npy":
                named = {f"{name}_" if name in _OF_SAVEZ else name: values for name, values in columns.items()}
                np.savez(file, points=points, **named)  # pyright: ignore[reportArgumentType]  it fears those names
                return
            if "ring" in columns:
                columns.setdefault("intensity", np.zeros(len(points), dtype=np.float32))
            write_marks(path, columns.get("filled"))
            np.save(file, np.column_stack([points, *(columns[name] for name in ROWS[3:] if name in columns)]))


def holds_points(path: Path) -> bool:
    """Return whether the header of an ``.npy`` is of points: rows of named numbers, or 3 to 5 numbers in each."""
    try:
        shape, _, dtype = parse_header(BytesIO(first_bytes(path, 2 * HEADER_BYTES_AT_MOST)))
    except ValueError:  # told where it is read
        return True
    if dtype.names:
        return {*"xyz"} <= {name.lower() for name in dtype.names}
    return dtype.kind in "fiu" and len(shape) in (2, 3) and bool({shape[0], shape[-1]} & {*WIDTHS})


@contextmanager
def _archive(file: BytesIO | BufferedReader, path: Path) -> Iterator[zipfile.ZipFile]:
    """Open an archive, or say in one line what is wrong with it or with an array that is read from it."""
    try:
        with open_archive(file) as archive:
            yield archive
    except ScanError:
        raise
    except ValueError as error:
        raise _unreadable(path, error) from None


def _unreadable(path: Path, error: ValueError) -> ScanError:
    if isinstance(error, NoNumbersError):
        return ScanError(
            f"{path}, which holds {error}", _FORMAT, "save its arrays as numbers, with a row for each point"
        )
    return damaged(path, _FORMAT, error)
