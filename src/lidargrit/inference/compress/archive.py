"""Compressed scans in one file: a header, the scans one after the other, and an index that finds each of them.

The file begins with ``LGZ2``, the length of the header and its CRC-32. It ends with the offset of the index, the CRC-32
of the index, and ``2ZGL``. Numbers have 32 bits, the offset 64, the lowest byte first. The header is JSON. The index is
compressed by zlib and has one line of JSON for each scan: name, number of bytes, their CRC-32, number of returns. The
scans lie without gaps, and one that was left out has no bytes. A file that was cut off, or of which one byte was
altered, is refused.
"""

import json
import os
import struct
import zlib
from array import array
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from lidargrit.core.errors import LidarGritError, OutputError, ScanError
from lidargrit.core.files import claim_folder, read_json, write_json
from lidargrit.core.untrusted import JSON_BYTES_AT_MOST, parse_json
from lidargrit.data.formats import open_file

_WANTED = "a file that lidargrit compress wrote"
UNFINISHED = ".unfinished"  # ending of the folder beside the file, in which it is written
_MAGIC, _END = b"LGZ2", b"2ZGL"
_START = struct.Struct("<4sII")
_TAIL = struct.Struct("<QI4s")
_INDEX_BYTES_AT_MOST = 256 * 2**20  # of the index's lines: those of a million scans take 50 MB
_LINE_BYTES_AT_MOST = 2**16  # a path and a few numbers
_SCANS_AT_MOST = 4_000_000  # ten times as many as the largest data set has
_CHUNK = 2**20
_STRICTER = {"bad_points": ["refuse"], "bad_scans": ["refuse"]}  # options by which no other scans were written so far


class Entry(NamedTuple):
    """A line of the index.

    Args:
        length: number of bytes of the scan; 0 for one that was left out.
        crc32: CRC-32 checksum of these bytes.
        num_returns: number of returns of the scan.
    """

    name: str
    length: int
    crc32: int
    num_returns: int

    @classmethod
    def of(cls, facts: Sequence[Any]) -> "Entry":
        """Check the facts of a line; raises TypeError or ValueError if they are none."""
        name, length, crc32, num_returns = facts
        if not (isinstance(name, str) and all(isinstance(each, int) for each in (length, crc32, num_returns))):
            raise ValueError
        if length < 0 or not 0 <= crc32 < 2**32:
            raise ValueError
        return cls(name, length, crc32, num_returns)


@contextmanager
def writing(path: Path, header: dict[str, Any], chosen: dict[str, Any] | None = None) -> "Iterator[ArchiveWriter]":
    """Give a writer of a file that appears when the block has ended well; if it was interrupted, the next goes on.

    Until then scans lie in a folder beside the file, named as the file with ``.unfinished``.

    Args:
        header: facts that all scans have in common, as JSON.
        chosen: options that say which scans these are, as JSON, to be kept beside an unfinished file.
    """
    folder = path.with_name(path.name + UNFINISHED)
    scans, index, options = folder / "scans", folder / "index", folder / "options.json"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with claim_folder(folder), scans.open("a+b") as scans_file, index.open("a+b") as index_file:
            writer = ArchiveWriter(scans_file, index_file, header, folder)
            writer.claim(options, chosen or {})
            try:
                yield writer
                writer.close()
                scans.replace(path)
                index.unlink()
                options.unlink()
            finally:
                if index.exists() and scans.stat().st_size <= writer.num_header_bytes:  # nothing to go on with
                    scans.unlink()
                    index.unlink()
                    options.unlink()
    except OSError as error:
        got = f"'{error.strerror or error}' while writing {path}"
        cure = "free some space; the same command goes on"
        raise OutputError(got, "a folder with room that may be written to", cure) from error
    finally:
        with suppress(OSError):
            folder.rmdir()  # unless it holds what the next command goes on with


class ArchiveWriter:
    """Writes a file of compressed scans, one by one, and keeps nothing of them in memory.

    Args:
        scans: file of the header and the scans, open to be read and appended to.
        index: file of the lines of the index, open to be read and appended to.
        header: facts that all scans have in common, as JSON.
    """

    def __init__(self, scans: BinaryIO, index: BinaryIO, header: dict[str, Any], folder: Path) -> None:
        self._scans, self._index, self._folder = scans, index, folder
        self.num_scans = self.num_returns = self.num_names = 0
        text = json.dumps(header, sort_keys=True).encode()
        self._start = _START.pack(_MAGIC, len(text), zlib.crc32(text)) + text
        self._offset = self.num_header_bytes = len(self._start)
        self._scans.seek(0)
        there = self._scans.read(len(self._start))
        if there != self._start[: len(there)]:
            raise self._of_others("scans of another model, step or version")
        if not there:
            self._scans.write(self._start)

    def claim(self, path: Path, chosen: dict[str, Any]) -> None:
        """Keep the options of the command, unless the file was begun with others: scans may all have the same names.

        A command that stopped at a bad point or scan may go on without it.
        """
        begun = read_json(path) if path.exists() else chosen
        changed = [name for name, of in chosen.items() if begun.get(name) not in (of, *_STRICTER.get(name, ()))]
        if changed:
            raise self._of_others(f"scans of other options ({', '.join(changed)})")
        write_json(path, chosen)

    def go_on(self, identities: Iterator[str]) -> int:
        """Keep the scans of an unfinished file, up to one that was not written whole, and return their number.

        Args:
            identities: identity of each of the scans that are to be written.
        """
        self._scans.seek(len(self._start))
        self._index.seek(0)
        end = 0
        for line in self._index:
            try:
                *facts, identity = parse_json(line, "a line of the index", list, ScanError)
                entry = Entry.of(facts)
            except (LidarGritError, TypeError, ValueError):
                break
            compressed = self._scans.read(entry.length)
            if not line.endswith(b"\n") or len(compressed) != entry.length or zlib.crc32(compressed) != entry.crc32:
                break
            if identity != next(identities, None):
                raise self._of_others(f"the scan {entry.name}, which is not the next of these")
            end += len(line)
            self._count(entry)
        self._index.truncate(end)
        self._scans.truncate(self._offset)
        self._scans.seek(0, 2)
        return self.num_names

    def add(self, name: str, identity: str, compressed: bytes, num_returns: int) -> None:
        """Write one scan; without bytes, that it was left out."""
        entry = Entry(name, len(compressed), zlib.crc32(compressed), num_returns)
        self._scans.write(compressed)
        self._scans.flush()
        self._index.write(json.dumps([*entry, identity]).encode() + b"\n")
        self._index.flush()
        self._count(entry)

    def close(self) -> None:
        """Write the index, after which the file is whole."""
        self._index.seek(0)
        packer, crc32 = zlib.compressobj(9), 0
        for line in self._index:
            *entry, _ = json.loads(line)
            crc32 = self._append(packer.compress(json.dumps(entry).encode() + b"\n"), crc32)
        crc32 = self._append(packer.flush(), crc32)
        self._scans.write(_TAIL.pack(self._offset, crc32, _END))
        self._scans.flush()
        os.fsync(self._scans.fileno())

    def _append(self, packed: bytes, crc32: int) -> int:
        self._scans.write(packed)
        return zlib.crc32(packed, crc32)

    def _count(self, entry: Entry) -> None:
        self._offset += entry.length
        self.num_names += 1
        self.num_scans += entry.length > 0
        self.num_returns += entry.num_returns

    def _of_others(self, held: str) -> OutputError:
        got = f"{self._folder}, an unfinished file with {held}"
        return OutputError(got, "the command that began it", "give that command again, or remove the folder")


class Archive:
    """A file of compressed scans, whose index is read at once and whose scans are read when they are asked for.

    Attributes:
        index_crc32: checksum of the index, which tells two files of scans with the same names apart.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.names = path, list[str]()
        lengths, crc32s = array("Q"), array("Q")
        with open_file(path, _WANTED) as file:
            size = file.seek(0, 2)
            header, begins = self._header(file, size)
            self.header = parse_json(header, str(path), dict, ScanError)
            index, scans_end = self._index(file, size)
        self.index_crc32 = zlib.crc32(index)
        end = begins
        for entry in self._entries(index):
            if entry.length:
                end += entry.length
                if end > scans_end:  # before a length or a sum that no array can hold
                    raise self._damaged()
                self.names.append(entry.name)
                lengths.append(entry.length)
                crc32s.append(entry.crc32)
        if end != scans_end or len(set(self.names)) < len(self.names):  # two scans would be one file
            raise self._damaged()
        self._ends = begins + np.cumsum(np.frombuffer(lengths, dtype=np.uint64), dtype=np.uint64)
        self._begins, self._crc32s = begins, crc32s

    def __len__(self) -> int:
        return len(self.names)

    def read(self, index: int) -> bytes:
        """Return the bytes of one scan."""
        begins, ends = int(self._ends[index - 1]) if index else self._begins, int(self._ends[index])
        with open_file(self.path, _WANTED) as file:
            file.seek(begins)
            compressed = file.read(ends - begins)
        if len(compressed) != ends - begins or zlib.crc32(compressed) != self._crc32s[index]:
            raise self._damaged()
        return compressed

    def check(self) -> None:
        """Read all scans, and refuse the file if one was altered."""
        for index in range(len(self)):
            self.read(index)

    def _header(self, file: BinaryIO, size: int) -> tuple[bytes, int]:
        file.seek(0)
        start = file.read(_START.size)
        if size < _START.size + _TAIL.size or start[:4] != _MAGIC:
            got = f"{self.path}, which does not begin as a file of compressed scans"
            raise ScanError(got, _WANTED, "check the path")
        _, length, crc32 = _START.unpack(start)
        header = file.read(min(length, size, JSON_BYTES_AT_MOST))
        if len(header) != length or zlib.crc32(header) != crc32:
            raise self._damaged()
        return header, _START.size + length

    def _index(self, file: BinaryIO, size: int) -> tuple[bytes, int]:
        """Return the compressed index, and where in the file it begins."""
        file.seek(size - _TAIL.size)
        offset, crc32, end = _TAIL.unpack(file.read(_TAIL.size))
        if end != _END or not offset <= size - _TAIL.size:
            raise self._damaged()
        file.seek(offset)
        packed = file.read(size - _TAIL.size - offset)
        if zlib.crc32(packed) != crc32:
            raise self._damaged()
        return packed, offset

    def _entries(self, packed: bytes) -> Iterator[Entry]:
        opened, rest, total, count = zlib.decompressobj(), b"", 0, 0
        try:
            while not opened.eof:
                text = opened.decompress(packed, _CHUNK)
                packed, total = opened.unconsumed_tail, total + len(text)
                *lines, rest = (rest + text).split(b"\n")
                for line in lines:
                    yield Entry.of(parse_json(line, "a line of the index", list, ScanError))
                    if (count := count + 1) > _SCANS_AT_MOST:
                        raise ValueError
                too_long = len(rest) > _LINE_BYTES_AT_MOST  # a line without end would be joined again and again
                if too_long or total > _INDEX_BYTES_AT_MOST or not (text or opened.eof):
                    raise ValueError
        except (zlib.error, ScanError, TypeError, ValueError):
            raise self._damaged() from None

    def _damaged(self) -> ScanError:
        got = f"{self.path}, which was cut off or altered (its checksums do not hold)"
        return ScanError(got, "the file as lidargrit compress wrote it", "copy it anew, or compress the scans anew")
