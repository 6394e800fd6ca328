"""Arrays that others wrote: the bytes of an .npy or .npz → numpy arrays, their sizes checked before memory is taken."""

import math
import struct
import warnings
import zipfile
from io import BufferedReader, BytesIO
from pathlib import Path

import numpy as np

from lidargrit.core.errors import first_words

ARRAY_BYTES_AT_MOST = 512 * 2**20  # unpacked; four million points of 16 columns
HEADER_BYTES_AT_MOST = 1024  # of an array; numpy writes 118, and reads it as a Python expression
DIRECTORY_BYTES_AT_MOST = 65_536  # of an archive: a thousand arrays
DIMENSIONS_AT_MOST = 4
_END_BYTES, _END_BYTES_64 = 22, 20  # of the records that end an archive; the second only in archives over 4 GB
_PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


class NoNumbersError(ValueError):
    """An array is whole, but holds no numbers, or has more axes than any of ours."""


def parse_header(file: BytesIO) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Return the shape of an .npy file's array, whether it lies column by column, and the type of its numbers.

    Args:
        file: bytes from the first on, which are read up to the numbers.

    Raises:
        ValueError: a damaged header.
    """
    try:
        version = np.lib.format.read_magic(file)
        size_bytes = 2 if version == (1, 0) else 4
        length = struct.unpack("<H" if version == (1, 0) else "<I", file.read(size_bytes))[0]
        if version not in ((1, 0), (2, 0)) or length > HEADER_BYTES_AT_MOST:
            raise ValueError(f"version {version}, a header of {length} bytes")
        file.seek(-size_bytes, 1)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        with warnings.catch_warnings(action="ignore"):  # of headers that Python 2 wrote
            return read(file, max_header_size=HEADER_BYTES_AT_MOST)
    except Exception as error:  # a damaged header is met with errors of many kinds
        raise ValueError(f"a damaged array ({first_words(error)})") from None


def parse_array(data: bytes, may_have_fields: bool = False) -> np.ndarray:
    """Return the array in the bytes of an .npy file; it shares their memory.

    Raises:
        NoNumbersError: other than numbers or truth values.
        ValueError: a damaged header, or fewer bytes than the shape needs.
    """
    file = BytesIO(data)
    shape, by_column, dtype = parse_header(file)
    # True is an int to numpy's reader, but not to those that then use the shape.
    plain = all(type(size) is int and size >= 0 for size in shape)
    fields = [of_field for of_field, *_ in dtype.fields.values()] if may_have_fields and dtype.fields else [dtype]
    kinds = {of_field.base.kind for of_field in fields}
    what = f"an array of {ascii(dtype)[:40]} and shape {str(shape)[:60]}"
    if not dtype.itemsize or not plain:
        raise ValueError(what)
    if not kinds <= {*"fiub"} or len(shape) > DIMENSIONS_AT_MOST:
        raise NoNumbersError(what)
    there, needed = len(data) - file.tell(), math.prod(shape) * dtype.itemsize
    if there < needed:
        raise ValueError(f"{there:,} bytes of an array that needs {needed:,}")
    values = np.frombuffer(data, dtype, math.prod(shape), file.tell())
    return values.reshape(shape, order="F" if by_column else "C")


def open_archive(file: BytesIO | BufferedReader) -> zipfile.ZipFile:
    """Open an .npz archive.

    Args:
        file: archive (.npz) that is open for reading, from its first byte to its last.

    Raises:
        ValueError: it is no archive, or its directory is too large.
    """
    try:
        size = file.seek(0, 2)
        if size < _END_BYTES:
            raise ValueError(f"{size} bytes, too few for an archive" if size else "an empty file")
        file.seek(max(0, size - _END_BYTES - _END_BYTES_64))
        end = file.read()
        directory_bytes = struct.unpack("<4s8xI6x", end[-_END_BYTES:])[1]
        is_large = end.startswith(b"PK\6\7") or directory_bytes > DIRECTORY_BYTES_AT_MOST
        if end[-_END_BYTES:][:4] != b"PK\5\6" or is_large:
            raise ValueError(f"no directory of at most {DIRECTORY_BYTES_AT_MOST} bytes at its end")
        return zipfile.ZipFile(file)
    except Exception as error:  # a damaged directory is met with errors of many kinds
        raise ValueError(first_words(error)) from None


def read_member(
    archive: zipfile.ZipFile,
    info: zipfile.ZipInfo,
    bytes_at_most: int = ARRAY_BYTES_AT_MOST,
    may_have_fields: bool = False,
) -> np.ndarray:
    """Unpack one array of an archive; what is raised is as of :func:`unpacked`."""
    return parse_array(unpacked(archive, info, bytes_at_most), may_have_fields)


def unpacked(archive: zipfile.ZipFile, info: zipfile.ZipInfo, bytes_at_most: int) -> bytes:
    """Return the bytes of one file of an archive.

    Raises:
        ValueError: it says that it is larger, is packed by another method than numpy's, or is damaged.
    """
    # Of other methods Python unpacks all that it has read at once, which may be a thousand times as much.
    if info.file_size > bytes_at_most or info.compress_type not in _PACKED:
        raise ValueError(f"{info.file_size:,} bytes in one array, packed by method {info.compress_type}")
    try:
        with archive.open(info) as file:
            return file.read(info.file_size)  # never more, whatever the packed bytes would unpack to
    except Exception as error:  # a damaged archive is met with errors of many kinds
        raise ValueError(f"a damaged array ({first_words(error)})") from None


def mapped_member(path: Path, name: str) -> np.ndarray:
    """Return one array of an archive that packs nothing; its numbers are read from disk when they are asked for.

    Raises:
        ValueError: no such array, a packed or damaged one, or other numbers than floating-point ones.
    """
    try:
        if not path.is_file():  # a pipe would hang
            raise ValueError("no file")
        with zipfile.ZipFile(path) as archive, path.open("rb") as file:
            info = archive.getinfo(f"{name}.npy")
            if info.compress_type != zipfile.ZIP_STORED:
                raise ValueError("a packed array, of which no part can be read alone")
            file.seek(info.header_offset + 26)  # lengths of the name and of what follows it
            start = info.header_offset + 30 + sum(struct.unpack("<HH", file.read(4)))
            file.seek(start)
            head = BytesIO(file.read(2 * HEADER_BYTES_AT_MOST))
        shape, by_column, dtype = parse_header(head)
        if by_column or dtype.kind != "f" or not all(type(size) is int and size >= 0 for size in shape):
            raise ValueError(f"an array of {ascii(dtype)[:40]} and shape {str(shape)[:60]}")
        return np.memmap(path, dtype, "c", start + head.tell(), shape)
    except Exception as error:  # a damaged archive is met with errors of many kinds
        raise ValueError(first_words(error)) from None


def member_header(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> tuple[tuple[int, ...], np.dtype]:
    """Return the shape of one array of an archive and the type of its numbers, which are not unpacked.

    Raises:
        ValueError: it is packed by another method than numpy's, or is damaged.
    """
    if info.compress_type not in _PACKED:
        raise ValueError(f"an array packed by method {info.compress_type}")
    try:
        with archive.open(info) as file:
            data = file.read(2 * HEADER_BYTES_AT_MOST)
    except Exception as error:  # a damaged archive is met with errors of many kinds
        raise ValueError(f"a damaged array ({first_words(error)})") from None
    shape, _, dtype = parse_header(BytesIO(data))
    return shape, dtype


def read_arrays(
    file: BytesIO | BufferedReader, names: tuple[str, ...], bytes_at_most: int = ARRAY_BYTES_AT_MOST
) -> dict[str, np.ndarray]:
    """Read those arrays of an .npz that are wanted and there; the others are not unpacked.

    Args:
        file: archive (.npz) that is open for reading, from its first byte to its last.

    Raises:
        ValueError: it is no archive, or a wanted array is too large or damaged.
    """
    with open_archive(file) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        return {name: read_member(archive, members[name], bytes_at_most) for name in names if name in members}
