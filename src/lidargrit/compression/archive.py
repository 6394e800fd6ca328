"""Compressed scans in one file: a header, the scans one after the other, and an index that finds each of them.

The file begins with ``LGZ1``, the length of the header and its CRC-32. It ends with the offset of the index, the CRC-32
of the index, and ``1ZGL``. Numbers have 32 bits, the offset 64, the lowest byte first. Header and index are JSON, the
index compressed by zlib. Each scan has a CRC-32 in the index, and the scans lie without gaps: a file that was cut off,
or of which one byte was altered, is refused.
"""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from lidargrit.errors import ScanError
from lidargrit.formats import open_file
from lidargrit.untrusted import JSON_BYTES_AT_MOST, parse_json

_WANTED = "a file that lidargrit compress wrote"
_MAGIC, _END = b"LGZ1", b"1ZGL"
_START = struct.Struct("<4sII")
_TAIL = struct.Struct("<QI4s")


class Entry(NamedTuple):
    """The part of the file that holds one scan.

    Args:
        name: name of the scan.
        offset: position of the scan's first byte in the file.
        length: number of bytes of the scan.
        crc32: CRC-32 checksum of these bytes.
    """

    name: str
    offset: int
    length: int
    crc32: int


class ArchiveWriter:
    """Writes a file of compressed scans, one by one; without :meth:`close` it is one that was cut off.

    Args:
        file: file that is open to be written.
        header: facts that all scans have in common, as JSON.
    """

    def __init__(self, file: BinaryIO, header: dict[str, Any]) -> None:
        self._file, self._entries = file, list[Entry]()
        text = json.dumps(header, sort_keys=True).encode()
        self._offset = file.write(_START.pack(_MAGIC, len(text), zlib.crc32(text))) + file.write(text)

    def add(self, name: str, compressed: bytes) -> None:
        """Write one scan."""
        self._entries.append(Entry(name, self._offset, len(compressed), zlib.crc32(compressed)))
        self._offset += self._file.write(compressed)

    def close(self) -> int:
        """Write the index, and return the size of the whole file in bytes."""
        index = zlib.compress(json.dumps([list(entry) for entry in self._entries]).encode(), 9)
        self._file.write(index)
        return self._offset + len(index) + self._file.write(_TAIL.pack(self._offset, zlib.crc32(index), _END))


class Archive:
    """A file of compressed scans, whose index is read at once and whose scans are read when they are asked for.

    Args:
        path: path of the file.

    Raises:
        ScanError: another kind of file, or one that was cut off or altered.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with open_file(path, _WANTED) as file:
            size = file.seek(0, 2)
            start, header, begins = self._header(file, size)
            self.header = parse_json(header, str(path), dict, ScanError)
            self.entries, end = self._index(file, size)
        for entry in self.entries:
            if entry.offset != begins or entry.length < 0:
                raise self._damaged()
            begins += entry.length
        if begins != end or start != _MAGIC:
            raise self._damaged()

    def __len__(self) -> int:
        return len(self.entries)

    def read(self, index: int) -> bytes:
        """Return the bytes of one scan.

        Raises:
            ScanError: altered bytes.
        """
        entry = self.entries[index]
        with open_file(self.path, _WANTED) as file:
            file.seek(entry.offset)
            compressed = file.read(entry.length)
        if len(compressed) != entry.length or zlib.crc32(compressed) != entry.crc32:
            raise self._damaged()
        return compressed

    def check(self) -> None:
        """Read all scans, and refuse the file if one was altered."""
        for index in range(len(self)):
            self.read(index)

    def _header(self, file: BinaryIO, size: int) -> tuple[bytes, bytes, int]:
        file.seek(0)
        start = file.read(_START.size)
        if size < _START.size + _TAIL.size or start[:4] != _MAGIC:
            got = f"{self.path}, which does not begin as a file of compressed scans"
            raise ScanError(got, _WANTED, "check the path")
        magic, length, crc32 = _START.unpack(start)
        header = file.read(min(length, size, JSON_BYTES_AT_MOST))
        if len(header) != length or zlib.crc32(header) != crc32:
            raise self._damaged()
        return magic, header, _START.size + length

    def _index(self, file: BinaryIO, size: int) -> tuple[list[Entry], int]:
        file.seek(size - _TAIL.size)
        offset, crc32, end = _TAIL.unpack(file.read(_TAIL.size))
        if end != _END or not offset <= size - _TAIL.size:
            raise self._damaged()
        file.seek(offset)
        packed = file.read(min(size - _TAIL.size - offset, JSON_BYTES_AT_MOST))
        if zlib.crc32(packed) != crc32:
            raise self._damaged()
        opened = zlib.decompressobj()
        try:
            text = opened.decompress(packed, JSON_BYTES_AT_MOST)
        except zlib.error:
            raise self._damaged() from None
        rows = parse_json(text, f"the index of {self.path}", list, ScanError)
        try:
            entries = [Entry(str(name), int(at), int(length), int(crc)) for name, at, length, crc in rows]
        except (TypeError, ValueError):
            raise self._damaged() from None
        if len({entry.name for entry in entries}) < len(entries):  # two scans would be one file
            raise self._damaged()
        return entries, offset

    def _damaged(self) -> ScanError:
        got = f"{self.path}, which was cut off or altered (its checksums do not hold)"
        return ScanError(got, "the file as lidargrit compress wrote it", "copy it anew, or compress the scans anew")
