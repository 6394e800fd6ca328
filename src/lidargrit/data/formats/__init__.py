"""Files of scans: a path → :class:`Scan`, whichever sensor or program wrote it; one format = one file here."""

import functools
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping
from io import BufferedReader
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from lidargrit.core import discovery
from lidargrit.core.errors import OutputError, ScanError, first_words
from lidargrit.scans.columns import BadPoints, ScanParts, treated_parts
from lidargrit.scans.file_rows import FileRows
from lidargrit.scans.types import Scan

_CURES = {  # by the ending, for files that hold scans but are not read
    (
        ".txt",
        ".xyz",
        ".asc",
        ".pts",
        ".xyzi",
    ): "put a line of names such as x y z intensity first, and end its name in .csv",
    (".laz",): "unpack it to .las, for instance with: laszip",
    (".zst", ".zstd"): "unpack it with: zstd -d",
    (".gz", ".bz2", ".xz", ".zip", ".7z"): "unpack it first",
    (".bag.active",): "finish it with: rosbag reindex",
    (".e57", ".ptx", ".pcd.lz4", ".rosbag"): "convert it to .pcd or .ply, for instance with CloudCompare",
}
_LINES_BYTES = 400
_SINCE_AN_EPOCH = 1e8  # seconds or their parts; no coordinate is as large, of a map either
_LINE_OF_A_POINT = re.compile(rb"\s*(?:[-+.\d][-+.\deE]*[ \t,;]+){2,6}[-+.\d][-+.\deE]*[ \t]*\r?(?:\n|\Z)")
_BETWEEN_NUMBERS = re.compile(rb"[ \t,;]+")
POINTS_AT_MOST = 4_000_000  # thirty revolutions of an HDL-64E; a larger file is a map, or no scan at all


class ScanFormat(ABC):
    """A file format of scans; the class has no state and is used without an instance."""

    title: ClassVar[str]
    """One line for lists."""
    suffixes: ClassVar[tuple[str, ...]]
    """How names of such files end, in lower case."""
    reflectance: ClassVar[str]
    """What the file's values are, and what they are divided by to lie in [0, 1]."""
    frame: ClassVar[str] = "x forward, y left, z up"
    """The axes in the file; scans that are read always have x forward, y left, z up."""
    sensor: ClassVar[str] = ""
    """The sensor that makes such files, if it is always the same."""
    several: ClassVar[bool] = False
    """Whether one file may hold more than one scan."""
    topics: ClassVar[bool] = False
    """Whether a user may choose by a name what is read of a file; then count and read take a ``topic``."""
    sensors: ClassVar[int] = 1
    """How many sensors a file has a scan of each; a set of scans is of the first, for the others have other rays."""
    keeps: ClassVar[tuple[str, ...]] = ()
    """What :meth:`write` keeps of a scan besides its points, in files of the first suffix: reflectance, ring, label."""
    companion: ClassVar[str] = ""
    """The file that must lie beside such a file for it to be read, if it needs one."""
    extra: ClassVar[str] = ""
    """Which optional part of this program reads them: pip install 'lidargrit[EXTRA]'."""

    @classmethod
    def public_name(cls) -> str:
        """Return the name that a user types: the file that defines the class."""
        return cls.__module__.rpartition(".")[2]

    @classmethod
    def about(cls) -> list[str]:
        """Return the facts of the format, one a line."""
        facts = [f"endings: {', '.join(cls.suffixes)}", f"reflectance: {cls.reflectance}", f"axes: {cls.frame}"]
        facts += [f"sensor: {cls.sensor}"] if cls.sensor else []
        facts += ["several scans in one file"] if cls.several else []
        facts += ["can be written: lidargrit export"] if cls.can_write() else []
        return facts + ([f"needs: pip install 'lidargrit[{cls.extra}]'"] if cls.extra else [])

    @classmethod
    def can_write(cls) -> bool:
        """Return whether scans can be written in it."""
        return cls._has_its_own("write") or cls.writes_columns()

    @classmethod
    def writes_columns(cls) -> bool:
        """Return whether named columns of any points can be written in it."""
        return cls._has_its_own("write_columns")

    @classmethod
    def keeps_labels(cls, file: str) -> bool:
        """Return whether a written file of such a name or ending keeps labels."""
        return "label" in cls.keeps and file.lower().endswith(cls.suffixes[0])

    @classmethod
    def _has_its_own(cls, method: str) -> bool:
        return any(method in base.__dict__ for base in cls.__mro__[: cls.__mro__.index(ScanFormat)])

    @staticmethod
    @abstractmethod
    def recognises(path: Path) -> bool:
        """Return whether a file looks like this format, from its first bytes; False if it cannot be read."""

    @staticmethod
    def count(path: Path) -> int:
        """Count the scans in a file, or raise ScanError."""
        return 1

    @staticmethod
    @abstractmethod
    def read(path: Path, index: int = 0, bad_points: BadPoints = "refuse") -> Scan:
        """Read one scan of a file, or raise ScanError."""

    @classmethod
    def of_topic(cls, topic: str) -> "type[ScanFormat]":
        """Return the format that reads one topic of a file, "" for what counts there; itself if files have none."""
        if not (topic and cls.topics):
            return cls
        chosen = {name: functools.partial(getattr(cls, name), topic=topic) for name in ("count", "read")}
        bound = {name: staticmethod(method) for name, method in chosen.items()}
        return type(cls.__name__, (cls,), {**bound, "__module__": cls.__module__})

    @staticmethod
    def sidecar_files(path: Path) -> tuple[Path, ...]:
        """Return the other files that :meth:`read` reads, where they are there."""
        return ()

    @classmethod
    def write(cls, path: Path, scan: Scan) -> None:
        """Write a scan to a new file."""
        cls.write_columns(path, cls.columns_of(scan))

    @classmethod
    def columns_of(cls, scan: Scan) -> dict[str, np.ndarray]:
        """Return the columns of a scan's file, one value for each point, by the names that the format has for them.

        Raises:
            OutputError: a format that is not written, or a scan that it does not hold.
        """
        raise cls._not_written()

    @classmethod
    def write_columns(cls, path: Path, columns: Mapping[str, np.ndarray]) -> None:
        """Write named columns of equal length to a new file; ``filled`` is 1 for points that a model added, else 0."""
        raise cls._not_written()

    @classmethod
    def _not_written(cls) -> OutputError:
        wanted, cure = "a format that can be written", "choose another format, such as bin or ply"
        return OutputError(f"a scan to write as {cls.title}", wanted, cure)


def load(name: str) -> type[ScanFormat]:
    """Return a format's class by its name, or raise UnknownNameError."""
    return discovery.load_class("formats", name, ScanFormat)


def candidates(path: Path) -> tuple[type[ScanFormat], ...]:
    """Return the formats whose files end as this one does; of several endings that fit, the longest counts."""
    return _formats_of_suffixes().get(_suffix(path), ())


def stem(path: Path) -> str:
    """Return a file's name without the ending of its format, which may hold several dots."""
    return path.name[: len(path.name) - len(_suffix(path))] if _suffix(path) else path.stem


def recognise(path: Path) -> type[ScanFormat]:
    """Return the format of a file, by its name and, where several formats share an ending, by what is in it."""
    named = candidates(path)
    open_file(path, named[0].title if named else "a file of a scan").close()
    if not named:
        known = ", ".join(sorted(_formats_of_suffixes()))
        raise ScanError(f"{path}, whose ending we do not know", f"one of {known}", cure_of_ending(path))
    if len(named) == 1:
        return named[0]
    return next((one for one in named if one.recognises(path)), named[0])  # the first says best what is wrong with it


def cure_of_ending(path: Path) -> str:
    """Return what to do with a file whose ending no format has, or that a program packed."""
    name = path.name.lower()
    return next((cure for endings, cure in _CURES.items() if name.endswith(endings)), "convert it")


def is_of_other_program(path: Path) -> bool:
    """Return whether a file is called like scans that we do not read.

    A ``.txt`` is one if its first line has 3 to 7 numbers, and if its lines do not begin with times: numbers that rise
    from line to line, from 0 or as large as seconds since an epoch. So are no poses (7 numbers and a time, or 12),
    times, places by GPS, and remarks.
    """
    name = path.name.lower()
    if name.endswith(".txt"):
        lines = first_bytes(path, _LINES_BYTES)
        return bool(_LINE_OF_A_POINT.match(lines)) and not _begin_with_times(lines)
    return name.endswith(tuple(ending for endings in _CURES for ending in endings))


def _begin_with_times(lines: bytes) -> bool:
    words = (_BETWEEN_NUMBERS.split(line.strip(), 1)[0] for line in lines.split(b"\n")[:-1])  # the last may be cut
    try:
        times = [float(word) for word in words if word]
    except ValueError:
        return False
    rise = all(before < after for before, after in pairwise(times))
    return len(times) > 1 and rise and (times[0] == 0 or times[0] > _SINCE_AN_EPOCH)


def read_scan(path: Path | str, index: int = 0, bad_points: BadPoints = "refuse") -> Scan:
    """Read a scan from a file of any format that we know.

    Args:
        index: number of the scan in the file, from 0.
        bad_points: ``drop`` removes points with NaN or infinite coordinates and points at the origin.
    """
    form = recognise(Path(path))
    if index:  # counting reads a whole recording
        count = form.count(Path(path))
        if not 0 <= index < count:
            raise ScanError(f"scan number {index} of {path}", f"one of its {count}, counted from 0", "take another")
    return form.read(Path(path), index, bad_points)


def count_scans(path: Path, topic: str = "") -> int:
    """Count the scans in a file; one, too, where the file cannot be read, which is said when it is."""
    if not any(one.several for one in candidates(path)):
        return 1  # without opening it: a folder may hold a hundred thousand
    try:
        return recognise(path).of_topic(topic).count(path)
    except ScanError:
        return 1


def _suffix(path: Path) -> str:
    fitting = [suffix for suffix in _formats_of_suffixes() if path.name.lower().endswith(suffix)]
    return max(fitting, key=len, default="")


@functools.cache
def _formats_of_suffixes() -> dict[str, tuple[type[ScanFormat], ...]]:
    table: dict[str, list[type[ScanFormat]]] = {}
    for name in discovery.names("formats"):
        for suffix in load(name).suffixes:
            table.setdefault(suffix, []).append(load(name))
    return {suffix: tuple(ones) for suffix, ones in table.items()}


def scan_of(
    points_xyz_m: Float[Tensor, "n 3"],
    reflectance: Float[Tensor, "n"] | None,
    ring: Int[Tensor, "n"] | None,
    source: str,
    bad_points: BadPoints,
    filled: Bool[Tensor, "n"] | None = None,
    rows: FileRows | None = None,
    point_time_s: Float64[Tensor, "n"] | None = None,
) -> Scan:
    """Make a scan of what a file holds, without points that are no returns if ``bad_points`` is ``drop``."""
    parts = ScanParts(
        points_xyz_m=points_xyz_m.contiguous(),
        reflectance=reflectance,
        ring=ring,
        filled=filled,
        rows=rows,
        point_time_s=point_time_s,
    )
    return Scan(**treated_parts(parts, bad_points), source=source)


def open_file(path: Path, wanted: str) -> BufferedReader:
    """Open a file to read its bytes."""
    try:
        if not path.is_file():  # opening a pipe or a device would hang
            what = "not a file" if path.exists() else "not there"
            raise ScanError(f"{path}, which is {what}", wanted, "check the path")
        return path.open("rb")
    except OSError as error:
        raise ScanError(f"{path}, which cannot be read ({error.strerror})", wanted, "check the path") from None


def read_bytes(path: Path, at_most: int, wanted: str) -> bytes:
    """Read a whole file of limited size."""
    with open_file(path, wanted) as file:
        try:
            size = os.fstat(file.fileno()).st_size
            data = file.read(size) if size <= at_most else b""  # read() makes room for all that it is asked for
        except OSError as error:
            raise ScanError(f"{path}, which cannot be read ({error.strerror})", wanted, "check the disk") from None
    if size > at_most:
        raise ScanError(f"{size:,} bytes in {path}", f"at most {at_most:,}: {wanted}", "split it into revolutions")
    if not data:
        raise ScanError(f"an empty file, {path}", wanted, "download it again, or remove it")
    return data


def first_bytes(path: Path, at_most: int) -> bytes:
    """Read the beginning of a file to recognise it by; nothing if it cannot be read."""
    try:
        with open_file(path, "") as file:
            return file.read(at_most)
    except (ScanError, OSError):
        return b""


def damaged(path: Path, wanted: str, error: Exception) -> ScanError:
    """Return the error of a file that a library could not read, with the library's reason in one line."""
    return ScanError(f"{path}, a damaged file ({first_words(error)})", wanted, "download it again, or remove it")
