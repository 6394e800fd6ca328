"""What data sets of files share: a folder → sorted paths; float32 rows x, y, z, reflectance ⇄ :class:`Scan`."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from lidargrit.datasets import BadPoints, ScanDataset, recognise
from lidargrit.datasets._splits import Split
from lidargrit.errors import DataError, OutputError, ScanError, nearest_names
from lidargrit.sensors import load_sensor
from lidargrit.structures import Scan

_ROW_BYTES = 16  # x, y, z, reflectance
_POINTS_AT_MOST = 4_000_000  # thirty revolutions of an HDL-64E; a larger file is a map, or no scan at all
_OTHER_ROWS = {
    12: "if its rows are x, y, z alone, add a fourth column of zeros",
    20: "if its rows have 5 columns, as nuScenes writes them, keep four and divide the intensity by 255",
}


class FileDataset(ScanDataset):
    """A data set with one file per scan."""

    patterns: ClassVar[tuple[str, ...]]
    """Where the files lie, seen from the root; the first pattern that finds any counts."""
    examples: ClassVar[tuple[str, ...]]
    """Where :meth:`write_example` puts scan number {index}, by turns."""

    def __init__(self, root: Path, split: str = "all", bad_points: BadPoints = "refuse") -> None:
        super().__init__(root, split, bad_points)
        found = {path: self.sequence_of(path.relative_to(root)) for path in self._find(root)}
        if not found:
            raise self._wrong_root()
        wanted = Split.parse(split)
        chosen = self._choose(wanted, set(found.values()))
        paths = [path for path, sequence in found.items() if sequence in chosen]
        self.paths = paths[wanted.block(len(paths))]
        if not self.paths:
            raise DataError(
                f"the split {split!r} of {len(paths)} scans in {root}, which leaves none",
                "at least one scan",
                "take a larger share",
            )

    def __len__(self) -> int:
        return len(self.paths)

    def scan(self, index: int) -> Scan:
        """Read one scan."""
        return self.read(self.paths[index], self.bad_points)

    def name(self, index: int) -> str:
        """Name one scan: its sequence and its file."""
        path = self.paths[index]
        sequence = self.sequence_of(path.relative_to(self.root))
        return path.stem if sequence == "." else f"{sequence}/{path.stem}"

    @classmethod
    def matches(cls, root: Path) -> bool:
        """Tell whether a folder holds a file where this tree has them, in the same format."""
        first = next((path for pattern in cls.patterns for path in root.glob(pattern)), None)
        return first is not None and cls.recognises(first)

    @classmethod
    def write_example(cls, root: Path, num_scans: int) -> None:
        """Write simulated scans as a small tree of this layout."""
        # Only here: a reader of files needs no simulator.
        from lidargrit.simulator import simulate  # noqa: PLC0415

        for index in range(num_scans):
            path = root / cls.examples[index % len(cls.examples)].format(index=index)
            if path.exists():
                raise OutputError(f"{path}, which exists", "a place to write to", "choose an empty folder")
            path.parent.mkdir(parents=True, exist_ok=True)
            cls.write(path, simulate(seed=index, sensor=load_sensor(cls.sensor)))

    @staticmethod
    @abstractmethod
    def sequence_of(relative: Path) -> str:
        """Name the sequence (drive, folder) of a file from its path below the root; "." for none."""

    @staticmethod
    @abstractmethod
    def recognises(path: Path) -> bool:
        """Tell whether a file looks like a scan of this format."""

    @staticmethod
    @abstractmethod
    def read(path: Path, bad_points: BadPoints) -> Scan:
        """Read the scan in a file, or raise ScanError."""

    @staticmethod
    @abstractmethod
    def write(path: Path, scan: Scan) -> None:
        """Write a scan to a new file."""

    @classmethod
    def _find(cls, root: Path) -> list[Path]:
        found = (sorted(root.glob(pattern)) for pattern in cls.patterns)
        return next((paths for paths in found if paths), [])

    def _choose(self, split: Split, sequences: set[str]) -> set[str]:
        named = {**self.splits, "all": tuple(sequences)}
        for part in split.parts:
            if part not in named and part not in sequences:
                raise DataError(
                    f"the split {split.text!r} of {self.root}, with {part!r} neither a split nor a sequence there",
                    f"one of {nearest_names(part, {*named, *sequences})}",
                    f"join several with '+', as in {'+'.join(sorted(sequences)[:2])}",
                )
        chosen = {sequence for part in split.parts for sequence in named.get(part, (part,))}
        if not chosen & sequences:
            raise DataError(
                f"the split {split.text!r} of {self.root}, none of whose sequences is there",
                f"a sequence among {', '.join(sorted(chosen))}",
                f"download one, or use what is there: {'+'.join(sorted(sequences)[:3])}",
            )
        return chosen & sequences

    def _wrong_root(self) -> DataError:
        if not self.root.is_dir():
            return DataError(f"{self.root}, which is not a folder", f"{self.tree} ({self.title})", "check the path")
        other = recognise(self.root)
        return DataError(
            f"{self.root}, which has no scan where this data set has them",
            f"{self.tree} ({self.title})",
            f"it looks like {other}: open it as {other}:{self.root}" if other else "give the ROOT of that tree",
        )


class BinDataset(FileDataset):
    """A data set of Velodyne files as KITTI writes them: float32 rows x, y, z, reflectance."""

    @staticmethod
    def recognises(path: Path) -> bool:
        """Tell whether there is a file; what is wrong with its rows is said when it is read."""
        return path.is_file()

    @staticmethod
    def read(path: Path, bad_points: BadPoints) -> Scan:
        """Read the scan in a file."""
        return read_bin(path, bad_points)

    @staticmethod
    def write(path: Path, scan: Scan) -> None:
        """Write a scan to a new file, with reflectance 0 if it has none."""
        reflectance = torch.zeros(len(scan)) if scan.reflectance is None else scan.reflectance
        rows = torch.cat((scan.points_xyz_m, reflectance[:, None]), dim=1)
        path.write_bytes(rows.numpy().astype("<f4").tobytes())


def read_bin(path: Path | str, bad_points: BadPoints = "refuse") -> Scan:
    """Read a Velodyne file as KITTI writes it: float32 rows x, y, z in metres and reflectance.

    Args:
        path: the file.
        bad_points: ``drop`` removes points with NaN or infinite coordinates and points at the origin.

    Returns:
        the points in the file's order, which on KITTI is the order in which they were fired.

    Raises:
        ScanError: the file is empty, unreadable, too large or of another format; or what :class:`Scan` refuses.
    """
    rows = torch.from_numpy(np.frombuffer(bytearray(_read_rows(Path(path))), dtype="<f4").reshape(-1, 4))
    if bad_points == "drop":
        xyz_m = rows[:, :3]
        rows = rows[xyz_m.isfinite().all(dim=1) & (xyz_m != 0).any(dim=1)]
    return Scan(rows[:, :3].contiguous(), rows[:, 3].contiguous(), source=str(path))


def _read_rows(path: Path) -> bytes:
    wanted = "float32 rows x, y, z, reflectance, 16 bytes a point"
    try:
        if not path.is_file():  # opening a pipe or a device would hang
            what = "not a file" if path.exists() else "not there"
            raise ScanError(f"{path}, which is {what}", wanted, "check the path")
        with path.open("rb") as file:
            data = file.read(_POINTS_AT_MOST * _ROW_BYTES + 1)
    except OSError as error:
        raise ScanError(f"{path}, which cannot be read ({error.strerror})", wanted, "check the path") from None
    size = len(data)
    if size == 0:
        raise ScanError(f"an empty file, {path}", wanted, "download it again, or remove it")
    if size > _POINTS_AT_MOST * _ROW_BYTES:
        raise ScanError(f"over {_POINTS_AT_MOST} points in {path}", f"one revolution: {wanted}", "remove the file")
    if size % _ROW_BYTES:
        cures = [cure for row_bytes, cure in _OTHER_ROWS.items() if size % row_bytes == 0]
        raise ScanError(
            f"{size} bytes in {path}, {size % _ROW_BYTES} more than whole points",
            wanted,
            " or ".join(cures) or "download it again: the file was cut short or is of another format",
        )
    return data
