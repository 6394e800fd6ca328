"""Scans that a command writes → a folder with a file for each, and a manifest by which the same command goes on."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from lidargrit.core import discovery, reporting
from lidargrit.core.errors import DataError, OutputError, UnknownNameError, no_usable_scan, one_of
from lidargrit.core.files import (
    atomic_path,
    claim_folder,
    claimed_manifest,
    is_partial,
    is_taken,
    read_json,
    write_json,
)
from lidargrit.core.reporting import Progress
from lidargrit.core.untrusted import user_path
from lidargrit.data import formats
from lidargrit.data.datasets.kitti_odometry import KittiOdometry
from lidargrit.data.datasets.shared.files import SENSOR_FILE
from lidargrit.data.datasets.shared.labels_beside import label_file
from lidargrit.data.datasets.shared.odometry import write_motions
from lidargrit.data.formats import ScanFormat
from lidargrit.data.formats.kitti_bin import KittiBin
from lidargrit.scans.many_scans import leaving_out
from lidargrit.scans.motion import Motion
from lidargrit.scans.sensors import SensorModel, load_sensor
from lidargrit.scans.types import Scan

TREE = "kitti_odometry"  # the data set that reads such a tree back
IMAGE = "image"  # the word for range images as .npy, in place of a format
_OF_FILES = "scans", "states"  # entries of a manifest that have a word for each file
_KITTI_NAME = re.compile(r"\d{2,}/\d{6}")  # sequence and number


class ScanIdentity(NamedTuple):
    """What identifies a scan, so that neither another one nor a changed one is taken for it.

    Args:
        name: name of the scan in its source, or words that say how it was made.
        state: sizes and times of the files that hold it; "" where none are known.
    """

    name: str
    state: str = ""

    def __str__(self) -> str:
        return f"{self.name} {self.state}"


class ScanFolder:
    """A folder of scans that a command writes; files that are there already are not written again.

    Args:
        out: an empty folder, or one that the same command began; more scans can be added to it.
        manifest: name of the file that says how the scans were made, and which file holds which.
        facts: entries of the manifest, among them the ``source``; a folder with other entries is refused.
        identities: identity of the scan in each file.

    Attributes:
        missing: indices of the files that are still to be written.
    """

    def __init__(
        self,
        out: Path,
        manifest: str,
        facts: dict[str, Any],
        files: Sequence[str],
        identities: Sequence[ScanIdentity],
        bad_scans: Literal["refuse", "skip"] = "refuse",
    ) -> None:
        check_names(facts["source"], files)
        if link := next((out / file for file in files if (out / file).is_symlink()), None):
            # What it leads to is not of this command, and would count as written.
            raise OutputError(f"{link}, which is a link", "a file of this command, or none", "remove the link")
        self.out, self.files, self._manifest = out, files, out / manifest
        of_files = dict(zip(files, identities, strict=True))
        folders = {str(folder) for file in files for folder in PurePosixPath(file).parents}
        if both := sorted(folders & of_files.keys()):
            got = f"a scan of {facts['source']} that would be {both[0]}, which is also the folder of another"
            raise DataError(got, "one name for each", "choose another --format, or rename some of the scans")
        self._facts = {**facts, "scans": {file: scan.name for file, scan in of_files.items()}}
        if states := {file: scan.state for file, scan in of_files.items() if scan.state}:
            self._facts["states"] = states
        self._bad_scans, self._left_out, self._told = bad_scans, set[str](), set[str]()
        self.missing = [index for index, file in enumerate(files) if not (out / file).exists()]

    @property
    def num_written(self) -> int:
        """Number of scans that are there once all is done."""
        return len(self.files) - len(self._left_out)

    @contextmanager
    def writing(self, what: str, remaining: int | None = None, total: int | None = None) -> Iterator[Progress]:
        """Hold the folder while its files are written, and yield the progress to be advanced by each.

        At the end, the manifest lists the files that were left out no more. If no scan was written, a new manifest is
        removed again.

        Args:
            what: name of the work, for the bar.
            remaining: number of scans that it is done with; those that are missing if not given.
            total: number of scans in all files; one in each if not given.
        """
        total = len(self.files) if total is None else total
        done = total - (len(self.missing) if remaining is None else remaining)
        with (
            claim_folder(self.out),
            claimed_manifest(self._manifest),
            reporting.progress(what, total, done) as progress,
        ):
            self._claim()
            yield progress
            if len(self._left_out) == len(self.files):
                raise no_usable_scan(self._facts["source"])
            if self._left_out:
                there = read_json(self._manifest)
                kept = {file: name for file, name in there["scans"].items() if file not in self._left_out}
                write_json(self._manifest, {**there, "scans": kept})

    @contextmanager
    def leaving_out(self, *indices: int) -> Iterator[None]:
        """Leave files out, with the reason, if their scan turns out to be unusable; or let the refusal through."""
        with leaving_out(self._bad_scans == "skip"):
            yield
            return
        self.leave_out(indices)

    def leave_out(self, indices: Sequence[int]) -> None:
        """Leave files out."""
        self._left_out.update(self.files[index] for index in indices)

    def is_left_out(self, index: int) -> bool:
        """Return whether a file is left out."""
        return self.files[index] in self._left_out

    def tell_labels_lost(self, file: str) -> None:
        """Tell, the first time, that a file by its ending keeps no labels."""
        self._tell_once("labels", f"{Path(file).suffix} keeps no labels; --format {TREE} or npz keeps them")

    def tell_sensor(self, sensor: SensorModel, file: str = "") -> None:
        """Write beside the scans on which rays their points lie; tell, the first time, of a file with other columns."""
        write_sensor(self.out, sensor)
        if file and (columns := load_sensor(self.out / SENSOR_FILE).width) != sensor.width:
            text = f"WARNING: {file} has {sensor.width} columns and {SENSOR_FILE} the {columns} of other scans, with "
            self._tell_once(
                "columns", f"{text}which commands image all; give each sensor's scans a folder of their own"
            )

    def _tell_once(self, what: str, text: str) -> None:
        if what not in self._told:
            self._told.add(what)
            reporting.message(text)

    def _claim(self) -> None:
        scans = self._facts["scans"]
        for file in scans:
            parts = PurePosixPath(file).parts
            if PurePosixPath(file).is_absolute() or ".." in parts or any(map(is_partial, parts)):
                raise OutputError(f"a scan that would lie outside, in {file}", "names below a folder", "rename it")
            user_path(str((self.out / file).absolute()), OutputError)  # refuses names that no file can have
        there = begun_by(self._manifest, self._difference)
        of_both = {
            name: {**(there or {}).get(name, {}), **self._facts[name]} for name in _OF_FILES if name in self._facts
        }
        if {**self._facts, **of_both} != there:
            write_json(self._manifest, {**self._facts, **of_both})

    def _difference(self, there: dict[str, Any]) -> str:
        known, states, facts, scans = there.get("scans"), there.get("states", {}), self._facts, self._facts["scans"]
        if not (isinstance(known, dict) and isinstance(states, dict)):
            return f"whose {self._manifest.name} lists no scans"
        if other := [
            name for name in sorted({*there, *self._facts} - {*_OF_FILES}) if there.get(name) != self._facts.get(name)
        ]:
            return f"whose {self._manifest.name} has another {other[0]!r}"
        if other := next((file for file, name in scans.items() if known.get(file, name) != name), None):
            return f"where {other} is another scan of {facts['source']}"
        missing, now = {self.files[index] for index in self.missing}, facts.get("states", {})
        changed = next(
            (file for file in now if file not in missing and (states.get(file) or now[file]) != now[file]), ""
        )
        return f"where {changed} is of a scan of {facts['source']} that has changed since" if changed else ""


def write_sensor(out: Path, sensor: SensorModel) -> None:
    """Write the sensor of a folder's scans, unless it is there."""
    if not (path := out / SENSOR_FILE).exists():
        write_json(path, sensor.to_json())


def begun_by(manifest: Path, difference: Callable[[dict[str, Any]], str]) -> dict[str, Any] | None:
    """Return the manifest that the same command wrote into a folder before; None where the folder is free.

    Args:
        manifest: file in the folder.
        difference: function of the manifest, in words how another command wrote it ("which holds ..."); "" if the same.
    """
    is_ours_or_taken = is_taken(manifest.parent)  # asked first: another process may begin it just now
    if manifest.is_file():
        there = read_json(manifest)
        if not (how := difference(there)):
            return there
    elif is_ours_or_taken:
        how = f"which is not empty and holds no {manifest.name}"
    else:
        return None
    wanted = "an empty folder, or one that this very command began"
    raise OutputError(f"{manifest.parent}, {how}", wanted, "choose another folder")


def check_names(source: str, names: Sequence[str]) -> None:
    """Raise DataError if several scans of a source would be one file: the last would replace others."""
    alike = Counter(str(PurePosixPath(name)) for name in names)  # "a" and "./a" are one file
    if twice := sorted(name for name, count in alike.items() if count > 1):
        got = f"several scans of {source} that would be {twice[0]}"
        raise DataError(got, "a name for each scan, as each becomes a file", "rename some, or take their folders apart")


def write_array(path: Path, pixels: Float[Tensor, "H W"]) -> None:
    """Write one value for each pixel as ``.npy``."""
    with atomic_path(path) as unfinished, unfinished.open("wb") as file:
        np.save(file, pixels.cpu().numpy())


class KittiTree:
    """The tree of KITTI odometry, with labels as SemanticKITTI has them."""

    keeps_labels = True
    sensor = KittiOdometry.sensor

    def __init__(self, out: Path) -> None:
        self._out = out

    def files(self, names: list[str]) -> list[str]:
        """Keep KITTI's own names; number other folders, and the scans in each, in their order."""
        if not all(map(_KITTI_NAME.fullmatch, names)):
            folders = [str(PurePosixPath(name).parent) for name in names]
            sequences = {folder: f"{number:02d}" for number, folder in enumerate(dict.fromkeys(folders))}
            seen: Counter[str] = Counter()
            numbered = []
            for folder in folders:
                numbered.append(f"{sequences[folder]}/{seen[folder]:06d}")
                seen[folder] += 1
            names = numbered
        return [f"sequences/{name[:-7]}/velodyne/{name[-6:]}.bin" for name in names]

    def write(self, file: str, scan: Scan) -> None:
        """Write a scan; see :func:`write_with_labels`."""
        write_with_labels(self._out / file, scan)

    def write_motions(self, files: Sequence[str], motions: Sequence[Motion]) -> None:
        """Write times and poses of sequences of which every scan has them, so that they are read as drives.

        Row n is of scan n. Where numbers are missing, as in a subset, it is of the n-th file.
        """
        sequences = dict[str, dict[str, Motion]]()
        for file, motion in zip(files, motions, strict=True):
            sequences.setdefault(PurePosixPath(file).parts[1], {})[file] = motion
        for sequence, of_files in sequences.items():
            known = self._in_rows(sequence, of_files)
            poses = [one.pose.numpy() for one in known if one.pose is not None]
            times_s = [one.time_s for one in known if one.time_s is not None]
            if any(one >= other for one, other in pairwise(times_s)):
                reporting.message(f"sequence {sequence} is written without times, which do not rise from scan to scan")
                times_s = []
            elif any(0 < len(some) < len(known) for some in (poses, times_s)):
                reporting.message(f"some scans of sequence {sequence} have no time or pose, so none is written")
            complete = len(poses) == len(known), len(times_s) == len(known)
            write_motions(self._out, sequence, poses * complete[0], times_s * complete[1])

    def _in_rows(self, sequence: str, of_files: dict[str, Motion]) -> list[Motion]:
        """Return what is to stand in each row; nothing where an earlier command wrote more scans, and their rows."""
        ordered = sorted(of_files)
        if ordered != [f"sequences/{sequence}/velodyne/{number:06d}.bin" for number in range(len(ordered))]:
            ordered = [file for file in ordered if (self._out / file).exists()]
        there = sum(1 for _ in (self._out / "sequences" / sequence / "velodyne").glob("*.bin"))
        return [] if len(ordered) < there else [of_files[file] for file in ordered]


def write_with_labels(path: Path, scan: Scan) -> None:
    """Write a scan into a file of KITTI odometry's tree, and its labels, if it has any, into that beside it."""
    if scan.label is not None:  # before the points, whose file says that the scan is complete
        with atomic_path(label_file(path)) as temporary:
            temporary.write_bytes(scan.label.numpy().astype("<u4").tobytes())
    KittiBin.write(path, scan)


def writable_format(kind: str, *others: str) -> tuple[type[ScanFormat], str]:
    """Return the format of a name or an ending, and the ending of its files.

    Args:
        others: words that the command takes besides, to be named in the message.
    """
    if kind in discovery.names("formats"):
        form, suffix = formats.load(kind), formats.load(kind).suffixes[0]
    else:
        suffix = f".{kind.lower().removeprefix('.')}"
        form = next((one for one in formats.candidates(Path(f"scan{suffix}")) if suffix in one.suffixes), None)
    if form is None or not form.can_write():
        known = [name for name in discovery.names("formats") if formats.load(name).can_write()]
        raise UnknownNameError(f"the format {kind!r} to write", one_of([*others, *known]), "choose one")
    return form, suffix
