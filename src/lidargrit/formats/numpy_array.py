"""NumPy's .npz of named arrays, or .npy of rows x, y, z, reflectance, ring ⇄ :class:`Scan`."""

from __future__ import annotations

import math
import struct
import warnings
import zipfile
from io import BufferedReader, BytesIO
from pathlib import Path

import numpy as np

from lidargrit.errors import ScanError
from lidargrit.files import atomic_path
from lidargrit.formats import POINTS_AT_MOST, BadPoints, ScanFormat, damaged, first_bytes, open_file, read_bytes
from lidargrit.formats._columns import BYTES_AT_MOST, REFLECTANCE_RULE, columns_of, known_name, scan_of_columns
from lidargrit.structures import Scan

_FORMAT = "an .npy of n rows of 3 to 5 numbers, or an .npz with an array points of n rows"
_HEADER_BYTES_AT_MOST = 1024  # of an array; numpy writes 118, and reads it as a Python expression
_VALUE_BYTES_AT_MOST = 16  # numpy's widest number
_DIRECTORY_BYTES_AT_MOST = 65_536  # of an archive: a thousand arrays
_ROWS = ("x", "y", "z", "intensity", "ring")
_POINTS = ("points", "xyz", "points_xyz_m")
_END_BYTES, _END_BYTES_64 = 22, 20  # of the records that end an archive; the second only in archives over 4 GB


class NumpyArray(ScanFormat):
    """Arrays as numpy saves them; objects, which are code, are never loaded.

    An ``.npy`` holds a row of x, y, z for every point, and reflectance and ring if the rows are longer. An ``.npz``
    holds such rows as ``points`` (or xyz), and if they are there reflectance (or reflectivity, intensity, remission,
    i), ring (or channel) and label as arrays of their own. The ``.npy`` of a scan with rings but without reflectance
    is given a reflectance of 0.
    """

    title = "NumPy array (.npz, .npy)"
    suffixes = (".npz", ".npy")
    reflectance = REFLECTANCE_RULE
    keeps = ("reflectance", "ring", "label")

    @staticmethod
    def recognises(path: Path) -> bool:
        """Tell whether a file is an array, or an archive with an array of points."""
        if first_bytes(path, 6) == b"\x93NUMPY":
            return True
        try:
            with open_file(path, _FORMAT) as file, _archive(file, path) as archive:
                return bool({f"{name}.npy" for name in _POINTS} & set(archive.namelist()))
        except (ScanError, OSError):
            return False

    @staticmethod
    def read(path: Path, index: int = 0, bad_points: BadPoints = "refuse") -> Scan:
        """Read the scan in a file."""
        data = read_bytes(path, BYTES_AT_MOST, _FORMAT)
        if data.startswith(b"\x93NUMPY"):
            columns = _row_columns(_array(data, path), path)
        else:
            with _archive(BytesIO(data), path) as archive:
                columns = _archive_columns(archive, path)
        return scan_of_columns(columns, path, bad_points)

    @classmethod
    def write(cls, path: Path, scan: Scan) -> None:
        """Write a scan to a new file, an ``.npy`` if the path ends so, which has no place for labels."""
        columns = columns_of(scan)
        points = np.stack([columns.pop(axis) for axis in "xyz"], axis=1)
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            if path.suffix.lower() != ".npy":
                np.savez(file, points=points, **columns)  # pyright: ignore[reportArgumentType]  it fears a column "allow_pickle"
                return
            if "ring" in columns:
                columns.setdefault("intensity", np.zeros(len(scan), dtype=np.float32))
            np.save(file, np.column_stack([points, *(columns[name] for name in _ROWS[3:] if name in columns)]))


def _row_columns(rows: np.ndarray, path: Path) -> dict[str, np.ndarray]:
    if rows.ndim != 2 or not 3 <= rows.shape[1] <= len(_ROWS):
        raise _refused(f"an array of shape {rows.shape}", path)
    return dict(zip(_ROWS, rows.T, strict=False))


def _archive_columns(archive: zipfile.ZipFile, path: Path) -> dict[str, np.ndarray]:
    members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
    points_name = next((name for name in _POINTS if name in members), None)
    if points_name is None:
        raise _refused(f"the arrays {', '.join(map(ascii, list(members)[:8]))[:120]}", path)
    columns = _row_columns(_member(archive, members.pop(points_name), BYTES_AT_MOST, path), path)
    at_most = _VALUE_BYTES_AT_MOST * len(columns["x"]) + _HEADER_BYTES_AT_MOST
    for member, info in members.items():
        name = known_name(member)
        # What else is in the archive is not unpacked, nor the same name again: with other capitals there are hundreds.
        if not name or name in columns:
            continue
        columns[name] = _member(archive, info, at_most, path)
        if columns[name].shape != columns["x"].shape:
            raise _refused(f"{columns['x'].shape[0]} points, but {name} of shape {columns[name].shape}", path)
    return columns


def _member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, at_most: int, path: Path) -> np.ndarray:
    """Unpack one array of an archive, after a look at how many bytes it says that it is."""
    if info.file_size > at_most or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise _refused(f"{info.file_size:,} bytes in one array, packed by method {info.compress_type}", path)
    try:
        with archive.open(info) as file:
            data = file.read(info.file_size)  # never more, whatever the packed bytes would unpack to
    except Exception as error:  # a damaged archive is met with errors of many kinds
        raise damaged(path, _FORMAT, error) from None
    return _array(data, path)


def _array(data: bytes, path: Path) -> np.ndarray:
    """Return the array in the bytes of an .npy file, after a look at its header."""
    file = BytesIO(data)
    try:
        version = np.lib.format.read_magic(file)
        length = struct.unpack("<H" if version == (1, 0) else "<I", file.read(2 if version == (1, 0) else 4))[0]
        if version not in ((1, 0), (2, 0)) or length > _HEADER_BYTES_AT_MOST:
            raise ValueError(f"version {version}, a header of {length} bytes")
        file.seek(-2 if version == (1, 0) else -4, 1)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        with warnings.catch_warnings(action="ignore"):  # of headers that Python 2 wrote
            shape, by_column, dtype = read(file, max_header_size=_HEADER_BYTES_AT_MOST)
    except Exception as error:  # a damaged header is met with errors of many kinds
        raise damaged(path, _FORMAT, error) from None
    if dtype.kind not in "fiu" or not 0 < len(shape) <= 2 or min(shape) < 0 or shape[0] > POINTS_AT_MOST:
        raise _refused(f"an array of {ascii(dtype)[:40]} and shape {str(shape)[:60]}", path)
    there, wanted = len(data) - file.tell(), math.prod(shape) * dtype.itemsize
    if there < wanted:
        raise _refused(f"{there} bytes of an array that needs {wanted}", path)
    values = np.frombuffer(data, dtype, math.prod(shape), file.tell())
    return values.reshape(shape, order="F" if by_column else "C")


def _archive(file: BytesIO | BufferedReader, path: Path) -> zipfile.ZipFile:
    """Open an archive, after a look at how large it says that its directory is."""
    try:
        size = file.seek(0, 2)
        file.seek(max(0, size - _END_BYTES - _END_BYTES_64))
        end = file.read()
        directory_bytes = struct.unpack("<4s8xI6x", end[-_END_BYTES:])[1]
        if (
            end[-_END_BYTES:][:4] != b"PK\5\6"
            or end.startswith(b"PK\6\7")
            or directory_bytes > _DIRECTORY_BYTES_AT_MOST
        ):
            raise zipfile.BadZipFile(f"no directory of at most {_DIRECTORY_BYTES_AT_MOST} bytes at its end")
        return zipfile.ZipFile(file)
    except Exception as error:  # a damaged directory is met with errors of many kinds
        raise damaged(path, _FORMAT, error) from None


def _refused(what: str, path: Path) -> ScanError:
    return ScanError(f"{path}, which holds {what}", _FORMAT, "save the points anew, or remove the file")
