"""What data sets of files share: a folder → its files in order, the split of them that is wanted, and their scans."""

import errno
import hashlib
import os
from collections import Counter
from collections.abc import Iterable, Iterator
from fnmatch import fnmatchcase
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import ClassVar

import numpy as np

from lidargrit.core.determinism import natural_order
from lidargrit.core.errors import DataError, ScanError, UsageError, nearest_names
from lidargrit.core.untrusted import check_word
from lidargrit.data import formats
from lidargrit.data.datasets import ScanDataset, recognise
from lidargrit.data.datasets.shared.poses_beside import motion_beside
from lidargrit.data.datasets.shared.splits import Split
from lidargrit.data.formats import BadPoints, ScanFormat
from lidargrit.scans.motion import Motion
from lidargrit.scans.projection.sensor_check import elevations_deg
from lidargrit.scans.types import Scan

_POINTS_AT_LEAST = 500  # fewer show no elevations
_HIGHEST_DEG, _ABOVE_AT_MOST = 8.0, 0.05  # an HDL-64E's beams end at +2; near the car some are seen from below
_LOWEST_DEG = -18.0  # of the 1 % quantile: KITTI's lies at -24 to -20, that of a VLP-16 at -15
_DROP: BadPoints = "drop"


def contradicts_hdl64e(path: Path, form: type[ScanFormat]) -> bool:
    """Return whether the points of a scan cannot be an HDL-64E's; False where too few tell.

    Args:
        form: format of that file.
    """
    try:
        points_m = form.read(path, 0, _DROP).points_xyz_m
    except ScanError:  # told where it is read
        return False
    if len(points_m) < _POINTS_AT_LEAST:
        return False
    elevation_deg = elevations_deg(points_m)
    above = float((elevation_deg > _HIGHEST_DEG).mean())
    return above > _ABOVE_AT_MOST or float(np.quantile(elevation_deg, 0.01)) > _LOWEST_DEG


SENSOR_FILE = "sensor.json"  # in the root of scans that the program wrote, and where fit-sensor may write
_NAMED_AT_MOST = 5  # sequences in a message
_SUBFOLDERS_AT_MOST = 100  # where a root is looked for that is one folder further down


class FileDataset(ScanDataset):
    """A data set of files, each with one scan, or several if its format allows it."""

    format: ClassVar[str]
    """Name of the files' format; empty where each file tells by its looks."""
    patterns: ClassVar[tuple[str, ...]]
    """Where the files lie, seen from the root; the first pattern that finds any counts."""
    topic: str = ""
    """Topic of recordings whose scans are wanted; empty for that which a format takes."""

    def __init__(self, root: Path, split: str = "all", bad_points: BadPoints = "refuse") -> None:
        super().__init__(root, split, bad_points)
        found = {path: self.sequence_of(path.relative_to(root)) for path in self._find()}
        if not found:
            raise self._wrong_root()
        _check_names(found)
        wanted = Split.parse(split, {*found.values()})
        chosen = self._choose(wanted, set(found.values()))
        paths = [path for path, sequence in found.items() if sequence in chosen]
        several = not self.format or formats.load(self.format).several
        scans = [(path, index) for path in paths for index in range(self.scans_in(path, self.topic) if several else 1)]
        self._scans = scans[wanted.block(len(scans))]
        self._several = {path for path, index in scans if index}
        names = Counter(
            (sequence, name) for path, sequence in found.items() for name in (path.name, formats.stem(path))
        )
        self._taken = {name for name, times in names.items() if times > 1}
        if not self._scans:
            raise DataError(
                f"the split {split!r} of {len(scans)} scans in {root}, which leaves none",
                "at least one scan",
                "take a larger share",
            )

    def __len__(self) -> int:
        return len(self._scans)

    def _sensor_beside(self) -> str:
        """Return the file ``sensor.json`` in the root, else the sensor of the data set."""
        file = self.root / SENSOR_FILE
        return str(file) if file.is_file() else type(self).sensor

    def scan(self, index: int) -> Scan:
        """Read one scan."""
        path, index_in_file = self._scans[index]
        return self._format(path).of_topic(self.topic).read(path, index_in_file, self.bad_points)

    def name(self, index: int) -> str:
        """Name one scan: its sequence, its file, and its index in the file if that holds several.

        The ending is left out, unless another file of the sequence would then be called the same.
        """
        path, index_in_file = self._scans[index]
        sequence = self.sequence_of(path.relative_to(self.root))
        stem = formats.stem(path)
        name = path.name if (sequence, stem) in self._taken else stem
        name += f"@{self.topic.strip('/').replace('/', '_')}" if self.topic else ""
        name += f"#{index_in_file}" if path in self._several else ""
        return name if sequence == "." else f"{sequence}/{name}"

    def within(self, index: int) -> str:
        """Return which scan of its file a scan is, by topic and number; "" where it is the only one."""
        path, index_in_file = self._scans[index]
        topic = f"@{self.topic}" if self.topic else ""
        return f"{topic}#{index_in_file}" if path in self._several else topic

    def path(self, index: int) -> Path:
        """Return the file that holds a scan."""
        return self._scans[index][0]

    def motion(self, index: int) -> Motion:
        """Return time and pose of a scan by ``times.txt`` and ``poses.txt`` in its folder or above it."""
        path = self.path(index)
        return Motion() if path in self._several else motion_beside(path)

    def sidecar_files(self, index: int) -> tuple[Path, ...]:
        """Return the other files that a scan is read from; tells formats apart by the ending, without opening any."""
        path = self.path(index)
        forms = [formats.load(self.format)] if self.format else formats.candidates(path)
        return tuple(companion for form in forms for companion in form.sidecar_files(path))

    def recording(self, index: int) -> str:
        """Name the recording that a scan was cut from, the same in every data set that has it."""
        path = self._scans[index][0]
        return self.recording_of(path) if self._is_its_own else unnamed_recording(path)

    @cached_property
    def _origin(self) -> str:
        return self.origin_of(self.root)  # asked for every scan, and looked up once

    @property
    def _is_its_own(self) -> bool:
        return self._origin == self.public_name()

    @classmethod
    def origin_of(cls, root: Path) -> str:
        """Return ``folder`` for a tree of this layout that another sensor filled: many programs write KITTI's."""
        if cls.format and cls.sensor.startswith("hdl64e"):
            found = (path for pattern in cls.patterns for path in root.glob(pattern))
            first = next(filter(_is_scan_file, found), None)
            if first and contradicts_hdl64e(first, cls._format(first)):
                return "folder"
        return cls.public_name()

    @property
    def named_sensor(self) -> str:
        """Name or file of the sensor; "" in a folder of others' files that name none."""
        return "" if self._origin == "folder" and self.sensor == type(self).sensor else self.sensor

    @classmethod
    def matches(cls, root: Path) -> bool:
        """Return whether a folder holds a file where this tree has them, in the same format.

        Where the tree names no folder, no other scans must lie below: they would go unseen.
        """
        pattern = cls._pattern_in(root)
        named = set((pattern or "").split("/")[:-1]) - {"*", "**"}
        return pattern is not None and (bool(named) or not cls._others_below(root, pattern))

    def sequence_of(self, relative: Path) -> str:
        """Name the sequence (drive) of a file from its path below the root, by default its folder; "." for none."""
        return relative.parent.as_posix()

    def recording_of(self, path: Path) -> str:
        """Name the recording of a file: its data set and sequence, or its folder where sequences have no names."""
        sequence = self.sequence_of(path.relative_to(self.root))
        return unnamed_recording(path) if sequence == "." else f"{self.public_name()}/{sequence}"

    @classmethod
    def scans_in(cls, path: Path, topic: str = "") -> int:
        """Count the scans in a file that belong to the data set, which is of one sensor."""
        of_several = any(form.sensors > 1 for form in formats.candidates(path))
        return 1 if of_several else formats.count_scans(path, topic)

    @classmethod
    def _format(cls, path: Path) -> type[formats.ScanFormat]:
        return formats.load(cls.format) if cls.format else formats.recognise(path)

    @classmethod
    def _pattern_in(cls, root: Path) -> str | None:
        """Return the first pattern that finds a file, if that is of this tree's format."""
        firsts = ((pattern, next(filter(_is_scan_file, root.glob(pattern)), None)) for pattern in cls.patterns)
        pattern, first = next((found for found in firsts if found[1]), (None, None))
        return pattern if first and cls._format(first).recognises(first) else None

    @classmethod
    def _others_below(cls, root: Path, pattern: str) -> bool:
        own = {*root.glob(pattern)}
        return any(is_recognised(path) for path in scans_below(root) if path not in own)

    def _find(self) -> list[Path]:
        for pattern in self.patterns:
            _check_readable(self.root, pattern)
            if found := natural_order(filter(_is_scan_file, self.root.glob(pattern))):
                return found
        return []

    def _choose(self, split: Split, sequences: set[str]) -> set[str]:
        named = self.splits()
        for part in split.parts:
            if part not in named and part not in sequences and part != "all":
                raise DataError(
                    f"the split {split.text!r} of {self.root}, with {part!r} neither a split nor a sequence there",
                    f"one such as {nearest_names(part, {'all', *named, *sequences})}",
                    f"join several with '+', as in {'+'.join(sorted(sequences)[:2])}",
                )
        if "all" in split.parts:
            return sequences
        wanted = {sequence for part in split.parts for sequence in named.get(part, (part,))}
        patterns = [of for part in split.parts for of in named.get(part, ()) if "*" in of]  # such as "train/*"
        chosen = {one for one in sequences if one in wanted or any(fnmatchcase(one, of) for of in patterns)}
        if not chosen:
            raise self._none_of(split, sequences, sorted(wanted))
        return chosen

    def _none_of(self, split: Split, sequences: set[str], wanted: list[str]) -> DataError:
        more = ", ..." if len(wanted) > _NAMED_AT_MOST else ""
        return DataError(
            f"the split {split.text!r} of {self.root}, none of whose sequences is there",
            f"a sequence among {', '.join(wanted[:_NAMED_AT_MOST])}{more}",
            f"download one, or use what is there: {'+'.join(sorted(sequences)[:3])}",
        )

    def _wrong_root(self) -> DataError:
        wanted = f"{self.tree} ({self.title})"
        if not self.root.is_dir():
            return DataError(f"{self.root}, which is not a folder", wanted, "check the path")
        got = f"{self.root}, which has no scan where this data set has them"
        if right := self._nearby_root():
            return DataError(got, wanted, f"its root may be {right}: try {self.public_name()}:{right}")
        other = recognise(self.root)
        cure = f"it looks like {other}: open it as {other}:{self.root}" if other else "give the ROOT of that tree"
        return DataError(got, wanted, cure)

    def _nearby_root(self) -> Path | None:
        """Find the root if the user named a folder within the tree, or the folder that contains the root."""
        if self.patterns[0].startswith("**"):  # any folder is a root
            return None
        here, depth = self.root.resolve(), self.patterns[0].count("/")
        below = (one for one in sorted(islice(here.iterdir(), _SUBFOLDERS_AT_MOST)) if one.is_dir())
        return next((one for one in (*below, *here.parents[:depth]) if self._pattern_in(one)), None)


def _check_readable(root: Path, pattern: str) -> None:
    """Refuse folders on the way to the scans that cannot be read: ``Path.glob`` would leave them out."""
    above = pattern.split("/")[:-1]
    for depth in range(1, len(above) + 1):
        for folder in root.glob("/".join(above[:depth])):
            if folder.is_dir() and not os.access(folder, os.R_OK | os.X_OK):
                raise _unreadable(folder, os.strerror(errno.EACCES))


def _check_names(paths: Iterable[Path]) -> None:
    """Refuse file names that are not UTF-8: they cannot be printed, nor written to a file for other programs."""
    try:
        for path in paths:
            check_word(str(path))
    except UsageError as error:
        raise DataError(error.got, error.wanted, error.cure) from None


def _is_scan_file(path: Path) -> bool:
    """Return whether a path that a pattern finds may be a scan: no folder, nor a hidden file such as macOS's ._NAME."""
    return not path.name.startswith(".") and not path.is_dir()


def scans_below(root: Path) -> Iterator[Path]:
    """Find all files that are called like a scan, in no order, leaving out hidden ones.

    Links to folders are followed after all folders that are none, so that these keep their names; once each, and not
    those that lead to a folder that has been searched or contains one.
    """
    if root.is_file():
        yield from [root] if formats.candidates(root) else []
        return
    seen, starts = {*root.resolve().parents}, [root]
    for start in starts:
        for folder, below, names in os.walk(start, onerror=_refuse_folder):
            place = Path(folder).resolve()
            if place in seen:  # a link to what another way leads to
                below.clear()
                continue
            seen.add(place)
            below[:] = sorted(name for name in below if not name.startswith("."))
            starts += [path for path in (Path(folder, name) for name in below) if path.is_symlink()]
            paths = (Path(folder, name) for name in names if not name.startswith("."))
            yield from (path for path in paths if formats.candidates(path))


def is_recognised(path: Path) -> bool:
    """Return whether a file that is called like a scan looks like one."""
    return any(form.recognises(path) for form in formats.candidates(path))


def _refuse_folder(error: OSError) -> None:
    if isinstance(error, (FileNotFoundError, NotADirectoryError)):  # a root that is not there has no scan
        return
    raise _unreadable(error.filename, error.strerror) from None


def _unreadable(folder: Path | str, why: str | None) -> DataError:
    what = f"{folder}, which cannot be read ({why})"
    return DataError(what, "a folder that you may read", "change its permissions, or move it elsewhere")


def unnamed_recording(path: Path) -> str:
    """Name the recording of a file by a hash of its folder, which does not reveal the path."""
    return hashed_name(path.resolve().parent)


def hashed_name(place: Path) -> str:
    """Name a recording by a hash of its file or folder, which does not reveal the path."""
    return f"#{hashlib.sha256(str(place).encode()).hexdigest()[:12]}/{place.name}"
