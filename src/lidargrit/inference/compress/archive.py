"""Compressed scans in one ZIP file, which holds what they have in common, their names, and each scan by its number.

``header.json`` and ``names.json`` are JSON; the scans ``0``, ``1``, ... are stored as they are, in the order of their
names. ZIP keeps a CRC-32 of each. Until all are there, they lie in a folder, a file each, in which a line of JSON
(name, identity, number of returns) comes before the bytes of the scan; one that was left out has none.
"""

import json
import os
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lidargrit.core.arrays import unpacked
from lidargrit.core.errors import OutputError, ScanError
from lidargrit.core.files import atomic_path, claim_folder, read_json, write_json
from lidargrit.core.untrusted import JSON_BYTES_AT_MOST, parse_json
from lidargrit.data.formats import open_file

_WANTED = "a file that lidargrit compress wrote"
UNFINISHED = ".unfinished"  # ending of the folder beside the file, in which it is written
_FORMAT = 3  # of the file; 1 and 2 were none of zip
_HEADER, _NAMES, _OPTIONS = "header.json", "names.json", "options.json"
_FIRST_BYTES = b"PK\3\4"
_STRICTER = {"bad_points": ["refuse"], "bad_scans": ["refuse"]}  # options by which no other scans were written so far


@dataclass(frozen=True)
class Compressed:
    """Size and content of a file of compressed scans.

    Args:
        num_returns: number of returns, or of points, of all scans.
        num_bytes: size of the whole file in bytes.
    """

    num_scans: int
    num_returns: int
    num_bytes: int

    @property
    def bits_per_return(self) -> float:
        """Bits of the whole file divided by the number of returns."""
        return 8 * self.num_bytes / max(self.num_returns, 1)


@contextmanager
def writing(path: Path, header: dict[str, Any], chosen: dict[str, Any] | None = None) -> "Iterator[ArchiveWriter]":
    """Give a writer of a file that appears when the block has ended well; if it was interrupted, the next goes on.

    Until then scans lie in a folder beside the file, named as the file with ``.unfinished``.

    Args:
        header: facts that all scans have in common, as JSON.
        chosen: options that say which scans these are, as JSON, to be kept beside an unfinished file.
    """
    folder = path.with_name(path.name + UNFINISHED)
    with claim_folder(folder):
        writer = ArchiveWriter(folder, {"format": _FORMAT, **header}, chosen or {})
        try:
            yield writer
            writer.write(path)
            writer.remove()
        finally:
            if not writer.sizes():  # nothing to go on with
                writer.remove()
    with suppress(OSError):
        folder.rmdir()


class ArchiveWriter:
    """Writes a file of compressed scans, of which several processes may compress some, and keeps none in memory.

    Args:
        folder: folder in which they lie until all are there.
        header: facts that all scans have in common, as JSON.
        chosen: options of the command, as JSON.
    """

    def __init__(self, folder: Path, header: dict[str, Any], chosen: dict[str, Any]) -> None:
        self.folder, self._header, options = folder, header, folder / _OPTIONS
        if self._numbers():
            self._claim(read_json(options), chosen)
        write_json(options, {"header": header, "chosen": chosen})

    def _claim(self, begun: dict[str, Any], chosen: dict[str, Any]) -> None:
        """Refuse a folder that was begun with other options, for scans may all have the same names.

        A command that stopped at a bad point or scan may go on without it.
        """
        before = begun.get("chosen")
        if begun.get("header") != self._header or not isinstance(before, dict):
            raise self._of_others("scans of another model, step or version")
        changed = [name for name, of in chosen.items() if before.get(name) not in (of, *_STRICTER.get(name, ()))]
        if changed:
            raise self._of_others(f"scans of other options ({', '.join(changed)})")

    def missing(self, identities: Sequence[str]) -> list[int]:
        """Return the numbers of the scans that are still to be written.

        Args:
            identities: identity of each of the scans that the file will hold.
        """
        there = self._numbers()
        for number in there:
            path = self.folder / str(number)
            with path.open("rb") as file:
                _, identity, _ = _facts(file.readline(), path)
            if identity not in identities[number : number + 1]:
                raise self._of_others(f"the scan {number}, {identity}, which is none of these")
        return sorted({*range(len(identities))} - {*there})

    def sizes(self) -> list[int]:
        """Return the number of returns of each scan that is there and was not left out."""
        return [returns for _, returns, compressed in self._written() if compressed]

    def write(self, path: Path) -> None:
        """Write the file."""
        names = []
        with atomic_path(path) as unfinished, zipfile.ZipFile(unfinished, "w") as archive:
            packed = zipfile.ZIP_DEFLATED if "rays" in self._header else zipfile.ZIP_STORED  # a long list of angles
            _add(archive, _HEADER, json.dumps(self._header, sort_keys=True).encode(), packed)
            for name, _, compressed in self._written():
                if compressed:
                    _add(archive, str(len(names)), compressed)
                    names.append(name)
            _add(archive, _NAMES, json.dumps(names).encode(), zipfile.ZIP_DEFLATED)

    def remove(self) -> None:
        """Remove the scans from the folder."""
        for name in [*map(str, self._numbers()), _OPTIONS]:
            (self.folder / name).unlink(missing_ok=True)

    def _numbers(self) -> list[int]:
        return sorted(int(entry.name) for entry in os.scandir(self.folder) if entry.name.isdecimal())

    def _written(self) -> Iterator[tuple[str, int, bytes]]:
        for number in self._numbers():
            path = self.folder / str(number)
            facts, _, compressed = path.read_bytes().partition(b"\n")
            name, _, returns = _facts(facts, path)
            yield name, returns, compressed

    def _of_others(self, held: str) -> OutputError:
        got = f"{self.folder}, an unfinished file with {held}"
        return OutputError(got, "the command that began it", "give that command again, or remove the folder")


def add_scan(folder: Path, number: int, facts: tuple[str, str, int], compressed: bytes) -> None:
    """Write one scan beside an unfinished file; without bytes, that it was left out.

    Args:
        facts: name, identity, and number of returns.
    """
    with atomic_path(folder / str(number)) as unfinished:
        unfinished.write_bytes(json.dumps(facts).encode() + b"\n" + compressed)


def _facts(line: bytes, path: Path) -> tuple[str, str, int]:
    wanted, cure = "a scan that lidargrit compress wrote", "remove it, and give the same command again"
    facts = parse_json(line, str(path), list, OutputError, wanted, cure)
    if [type(each) for each in facts] != [str, str, int]:
        raise OutputError(f"{path}, which does not begin with a name, an identity and a number", wanted, cure)
    name, identity, returns = facts
    return name, identity, returns


def _add(archive: zipfile.ZipFile, name: str, data: bytes, method: int = zipfile.ZIP_STORED) -> None:
    """Add a member with the date that ZIP files begin with: the same scans give the same file."""
    archive.writestr(zipfile.ZipInfo(name), data, method, compresslevel=9)


class Archive:
    """A file of compressed scans, whose names are read at once and whose scans are read when they are asked for.

    Attributes:
        index_crc32: checksum of names and scans, which tells two files of scans with the same names apart.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with open_file(path, _WANTED) as file:
            if file.read(len(_FIRST_BYTES)) != _FIRST_BYTES:
                got = f"{path}, which does not begin as a file of compressed scans"
                raise ScanError(got, _WANTED, "check the path")
            size = os.fstat(file.fileno()).st_size
        with self._damage_told():
            self._archive = zipfile.ZipFile(path)
            files = map(self._archive.getinfo, (_HEADER, _NAMES))
            header, names = (unpacked(self._archive, file, JSON_BYTES_AT_MOST) for file in files)
            self.header = parse_json(header, str(path), dict, ScanError)
            self.names = parse_json(names, str(path), list, ScanError)
            self._scans = [self._archive.getinfo(str(number)) for number in range(len(self.names))]
            # Stored as they are, scans of a file are no larger than it; two of one name would be one file.
            stored = all(scan.compress_type == zipfile.ZIP_STORED for scan in self._scans)
            fits = stored and sum(scan.file_size for scan in self._scans) <= size
            if not fits or not all(isinstance(name, str) for name in self.names):
                raise ValueError
            if self.header.get("format") != _FORMAT or len(set(self.names)) < len(self.names):
                raise ValueError
        self.index_crc32 = zlib.crc32(json.dumps([self.names, [scan.CRC for scan in self._scans]]).encode())

    def __len__(self) -> int:
        return len(self.names)

    def read(self, index: int) -> bytes:
        """Return the bytes of one scan."""
        with self._damage_told():
            return self._archive.read(self._scans[index])

    def check(self) -> None:
        """Read all scans, and refuse the file if one was altered."""
        for index in range(len(self)):
            self.read(index)

    @contextmanager
    def _damage_told(self) -> Iterator[None]:
        try:
            yield
        except Exception:  # a damaged archive is met with errors of many kinds
            got = f"{self.path}, which was cut off or altered (its checksums do not hold)"
            cure = "copy it anew, or compress the scans anew"
            raise ScanError(got, "the file as lidargrit compress wrote it", cure) from None
