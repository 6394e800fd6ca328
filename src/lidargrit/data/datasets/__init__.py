"""Data sets of scans, recorded and simulated: "NAME:ROOT:SPLIT" → :class:`ScanDataset`."""

import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import ClassVar

from lidargrit.core import discovery
from lidargrit.core.errors import ConfigError, DataError, printable
from lidargrit.core.untrusted import user_path
from lidargrit.data import formats
from lidargrit.data.formats import BadPoints
from lidargrit.data.windows import TimedScan, drives_in
from lidargrit.scans.motion import Motion
from lidargrit.scans.types import Scan

_FILES_TO_LOOK_AT = 10_000  # of a folder without any scan that is read
_PACKED = {".gz", ".bz2", ".xz", ".zst", ".zstd", ".zip", ".active"}
_SHARE = re.compile(r"\[[^\]/]*\]$")


@dataclass(frozen=True)
class SplitScheme:
    """One division of a data set into parts, as a paper or program defines it.

    Args:
        leak: one sentence on what the parts share but should not, for everyone who compares scores on them.
        parts: sequences of each part: train, val, test.
    """

    source: str
    leak: str
    parts: Mapping[str, tuple[str, ...]]


class ScanDataset(ABC):
    """An ordered collection of scans that one sensor made.

    A split is ``all``, a part of a scheme such as ``lidargen-code/train``, or sequences (drives), joined by "+" as in
    ``00+03``; ``train`` alone is the part of the first scheme. A share in brackets takes one
    contiguous block of the scans in order: ``all[:90%]`` and ``all[90%:]`` have no scan in common. Blocks keep
    neighbours in time together, but where one ends within a drive, the same street is seen from both sides of the cut:
    scans near it leak from one share to the other. Whole drives leak least.

    A part takes those of its sequences that are on disk, so that part of a data set can be used.

    Args:
        root: the folder that ``tree`` starts from.
        split: name or range of the wanted scans, such as ``val`` or ``all[:10%]``.
        bad_points: ``refuse`` a scan with NaN, infinite or all-zero coordinates, or ``drop`` such points.

    Raises:
        DataError: the folder does not hold the tree, no scan, or not the split.
    """

    title: ClassVar[str]
    """What the data set calls itself."""
    licence: ClassVar[str]
    """Under what terms its scans may be used."""
    tree: ClassVar[str]
    """How its files lie below the root."""
    citation: ClassVar[str] = ""
    """The paper that describes it."""
    sensor: str
    """Name of the sensor that made the scans."""
    sensors_differ: ClassVar[bool] = False
    """Whether its scans may be of other sensors than :attr:`sensor`, which is then the commonest."""
    notes: tuple[str, ...] = ()
    """Sentences on files that were left out."""
    schemes: ClassVar[dict[str, SplitScheme]] = {}
    """The published ways to divide it by name; the first is the default."""

    def __init__(self, root: Path, split: str = "all", bad_points: BadPoints = "refuse") -> None:
        self.root, self.split = root, split
        self.bad_points: BadPoints = bad_points

    @classmethod
    def public_name(cls) -> str:
        """Return the name that a user types: the file that defines the class."""
        return cls.__module__.rpartition(".")[2]

    @classmethod
    def origin_of(cls, root: Path) -> str:
        """Return the data set that made the scans of a tree; "" if it is not known.

        It is another one where the program itself wrote the tree, as ``simulate`` and ``export`` do.
        """
        return cls.public_name()

    @property
    def named_sensor(self) -> str:
        """Name or file of the sensor; "" where neither the data set nor a file beside the scans names it."""
        return self.sensor

    @abstractmethod
    def __len__(self) -> int:
        """Count the scans."""

    @abstractmethod
    def scan(self, index: int) -> Scan:
        """Read one scan.

        Raises:
            ScanError: the file cannot be used.
        """

    @abstractmethod
    def name(self, index: int) -> str:
        """Name one scan, the same on every machine and in every split: "00/000012"."""

    def within(self, index: int) -> str:
        """Return which scan of its file a scan is, by topic and number; "" where it is the only one."""
        return ""

    def recording(self, index: int) -> str:
        """Name the recording that a scan was cut from, the same in every data set that has it; "" if it is alone."""
        return ""

    def motion(self, index: int) -> Motion:
        """Return when and where a scan was made, as far as files beside it tell.

        Raises:
            DataError: such a file is damaged.
        """
        return Motion()

    def timed_scans(self, indices: Iterable[int] | None = None) -> list[TimedScan]:
        """Return when and where scans were made, as far as that is known; all of them if no indices are given."""
        some = range(len(self)) if indices is None else indices
        return [TimedScan(self.name(at), self.recording(at), self.motion(at)) for at in some]

    def windows(self, frames: int) -> "list[Window]":
        """Return all runs of scans that follow one another in one drive, in order of time.

        Each run begins one scan after the one before it. Scans whose time is not known are in none; where a drive ends
        early, see :func:`lidargrit.data.windows.drives_in`.

        Args:
            frames: number of scans in each run.

        Raises:
            ConfigError: a number below 1.
            DataError: a file of times or poses that is damaged.
        """
        if frames < 1:
            raise ConfigError(f"windows of {frames} scans", "at least 1", "correct it")
        scans = self.timed_scans()
        return [
            Window(self, tuple(drive[first : first + frames]))
            for drive in drives_in(scans, with_poses=False)
            for first in range(len(drive) - frames + 1)
        ]

    def path(self, index: int) -> Path | None:
        """Return the file that holds a scan; None where scans are not in files."""
        return None

    def sidecar_files(self, index: int) -> tuple[Path, ...]:
        """Return the other files that a scan is read from, such as a calibration, where they are there."""
        return ()

    def takes_files_in(self, folder: Path) -> bool:
        """Return whether scans that are written to a folder would become scans of this data set."""
        return False

    @classmethod
    def splits(cls) -> dict[str, tuple[str, ...]]:
        """Return the sequences of every named split: "train" of the first scheme, "SCHEME/train" of each."""
        named = {f"{name}/{part}": of for name, scheme in cls.schemes.items() for part, of in scheme.parts.items()}
        default = next(iter(cls.schemes.values()), None)
        return {**(default.parts if default else {}), **named}

    @classmethod
    @abstractmethod
    def matches(cls, root: Path) -> bool:
        """Return whether a folder looks like this tree."""


@dataclass(frozen=True)
class Window:
    """Scans of one recording in order of time."""

    dataset: ScanDataset
    indices: tuple[int, ...]

    def scans(self) -> list[Scan]:
        """Read the scans, each with its time, and its pose where that is known."""
        return [self._scan(at) for at in self.indices]

    def _scan(self, index: int) -> Scan:
        scan, motion = self.dataset.scan(index), self.dataset.motion(index)
        time_s = scan.time_s if motion.time_s is None else motion.time_s  # messages of ROS have one of their own
        return replace(scan, time_s=time_s, pose=motion.pose)


def open_dataset(source: str, bad_points: BadPoints = "refuse") -> ScanDataset:
    """Open a data set by its name and its folder.

    Args:
        source: "NAME:ROOT" or "NAME:ROOT:SPLIT"; "ROOT" or "ROOT:SPLIT" to have the layout recognised;
            "simulated:COUNT" or "simulated:COUNT:SPLIT" for scans of procedural streets, "simulated:COUNT@SENSOR" for
            those that another sensor makes of them.
        bad_points: see :class:`ScanDataset`.

    Raises:
        UnknownNameError: no data set of that name; names its nearest neighbours.
        DataError: the folder does not hold the tree, no scan, or not the split.

    Example:
        >>> open_dataset("simulated:100:val").name(0)
        'seed_1000000'
    """
    if not source.strip():
        raise DataError("an empty source", "a folder, or NAME:ROOT", "name one; a comma at the end leaves an empty one")
    share = _SHARE.search(source)
    head, colon, rest = source.partition(":")
    if share and share.start() < len(head):  # the first colon is that of the share
        head, colon, rest = source[: share.start()], "", ""
    root, split = _root_and_split(source)
    is_path = "/" in head or _is_there(head) or (head != "" and root.exists())  # a name may have a colon
    if head in discovery.names("datasets") and (colon or not is_path):
        if not rest:
            raise DataError(
                f"the source {source!r} alone",
                f"{head}: followed by {load(head).tree}",
                "type NAME:ROOT, such as kitti_raw:/data/kitti_raw, or simulated:1000",
            )
        root, split = _root_and_split(rest)
        return load(head)(root, split, bad_points)
    if colon and not is_path:
        load(head)  # raises: no such name
    name = recognise(root)
    if name is None:
        cure = "check the path, or see the layouts with: lidargrit list datasets"
        if root.is_dir() and not any(root.iterdir()):
            raise DataError(f"{root}, which is an empty folder", "one with scans in it", cure)
        if root.is_dir() and (others := files_of_others(root)):
            raise DataError(f"{root}, which holds no scan that we read but {others[0]}", "scans", others[1])
        got = "holds no layout we know" if root.is_dir() else "is not a folder" if root.exists() else "does not exist"
        raise DataError(f"{root}, which {got}", "scans: a file, a folder or the root of a data set", cure)
    return load(name)(root, split, bad_points)


def files_of_others(root: Path) -> tuple[str, str] | None:
    """Return which files of a folder are called like scans but are not read, in a few words, and what to do with them.

    Args:
        root: folder that is searched, with those below it.
    """
    counted: Counter[str] = Counter()
    cures: dict[str, str] = {}
    for path in islice(root.rglob("*"), _FILES_TO_LOOK_AT):
        is_hidden = any(part.startswith(".") for part in path.relative_to(root).parts)
        if not is_hidden and formats.is_of_other_program(path) and path.is_file():
            ending = printable("".join(path.suffixes[-2:]) if path.suffix in _PACKED else path.suffix)[:20]
            counted[ending] += 1
            cures[ending] = formats.cure_of_ending(path)
    if not counted:
        return None
    most = counted.most_common(3)
    found = ", ".join(f"{count:,} {'file' if count == 1 else 'files'} {ending}" for ending, count in most)
    ending = most[0][0]
    return found, cures[ending] if len({*cures.values()}) == 1 else f"of {ending}: {cures[ending]}"


def data_set_and_split(source: str) -> tuple[str, str]:
    """Return the data set and the split of a source, without its folder; "" for what is not known.

    Example:
        >>> data_set_and_split("kitti_360:/data/kitti_360:train")
        ('kitti_360', 'train')
    """
    name, root, split = _name_root_and_split(source)
    if not name and root.is_dir():
        name = recognise(root, crawl=False) or "folder"
    origin = load(name).origin_of(root) if name else ""
    if origin != name:
        return origin, ""
    known = load(name).splits() if name else {}
    part = split.partition("[")[0]
    return name, split if part in known or "/" not in part else ""


def root_of(source: str) -> Path:
    """Return the folder of a source, without its data set and split."""
    return _name_root_and_split(source)[1]


def _name_root_and_split(source: str) -> tuple[str, Path, str]:
    """Take a source apart; the name is "" where none is typed."""
    head, colon, rest = source.partition(":")
    name = head if colon and head in discovery.names("datasets") else ""
    return name, *_root_and_split(rest if name else source)


def load(name: str) -> type[ScanDataset]:
    """Return a data set's class by its name, or raise UnknownNameError."""
    return discovery.load_class("datasets", name, ScanDataset)


def recognise(root: Path, crawl: bool = True) -> str | None:
    """Return the name of the data set whose layout a folder has: the most specific match, None if there is none.

    Args:
        root: folder to look into.
        crawl: also try layouts whose files may lie at any depth, for which the whole folder is searched.
    """
    every = {name: load(name).tree for name in discovery.names("datasets")}
    trees = {name: tree for name, tree in every.items() if crawl or "**" not in tree}
    most_specific_first = sorted(trees, key=lambda name: ("**" in trees[name], -trees[name].count("/"), name))
    return next((name for name in most_specific_first if load(name).matches(root)), None)


def _is_there(text: str) -> bool:
    try:
        return user_path(text).exists()
    except DataError:  # no file can be called so
        return False


def _root_and_split(text: str) -> tuple[Path, str]:
    if _is_there(text):  # colons and brackets of a folder that exists are its own
        return user_path(text), "all"
    share = _SHARE.search(text)
    before = text[: share.start()] if share else text
    root, colon, split = before.rpartition(":")
    if not colon:
        root, split = before, "all"
    folder = user_path(root) if root else Path()  # published runs name a data set and a split, and no folder
    return folder, split + (share[0] if share else "")
