"""Scans for other programs: samples, prepared scans or a data set → a folder of point clouds, or a KITTI tree."""

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from lidargrit.core import discovery, reporting
from lidargrit.core.errors import ConfigError, DataError, OutputError, ScanError, UnknownNameError, one_of, printable
from lidargrit.core.files import (
    atomic_path,
    claim_folder,
    claimed_manifest,
    is_partial,
    is_taken,
    read_json,
    write_json,
)
from lidargrit.core.untrusted import user_path
from lidargrit.data import formats
from lidargrit.data.formats import ScanFormat
from lidargrit.data.formats.kitti_bin import KittiBin
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import open_source
from lidargrit.data.sources.image_files import ImageFileSource
from lidargrit.data.sources.named import ImageScans, NamedScans, named_scans
from lidargrit.scans.motion import UndoMotion
from lidargrit.scans.rescan import Rescan
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import Scan

MANIFEST = "export.json"
TREE = "kitti_odometry"  # the data set that reads such a tree back
IMAGE = "image"  # the word for range images as .npy, in place of a format
_KITTI_NAME = re.compile(r"\d{2,}/\d{6}")  # sequence and number


def export_scans(
    source: str,
    out: Path,
    kind: str,
    config: DataConfig | None = None,
    sensor: SensorModel | None = None,
    change: Rescan | UndoMotion | None = None,
) -> int:
    """Write every scan of a source to a file of its own; files that are there already are not written again.

    Scans keep their own points; a range image gives one point for each return, on the ray of its pixel. Files have the
    names of the scans, or ``NNNNNN``, the index, for samples and prepared scans. ``export.json`` says which file holds
    which scan.

    Args:
        source: samples of ours or of another program, a prepared folder, or a source of scans.
        out: an empty folder, or one that the same command began; more scans can be added to it.
        kind: a format's name or one of its endings ("pcd", "npz", ...), or ``kitti_odometry`` for the tree
            ``sequences/SS/velodyne/NNNNNN.bin``, with SemanticKITTI's ``labels/NNNNNN.label`` where scans have labels.
        config: number of scans, and what to do with unusable points and scans; nothing else of it is used.
        sensor: sensor of range images that do not name theirs, as ``.npy``; no other source takes one.
        change: work on each scan before it is written; scans stay as they are if not given.

    Returns:
        Number of scans that are there now.

    Raises:
        UnknownNameError: no such format.
        ConfigError: a sensor for a source that has its own.
        OutputError: the folder holds something else, lies in the source, or cannot be written.
        DataError: no such source, or no usable scan in it.
        ScanError: a scan that cannot be used.
    """
    config = config or DataConfig()
    layout = KittiTree(out) if kind == TREE else _Flat(out, *writable_format(kind, TREE))
    scans, of_images = _open(source, config, sensor)
    read = scans.scan if change is None else _Changed(scans, change)
    scans.check_output(out)
    files = layout.files([scans.name(index) for index in range(len(scans))])
    check_names(source, files)
    facts = {"source": source, "format": kind, **of_images, **(change.identity() if change else {})}
    facts["scans"] = {file: scans.identity(index) for index, file in enumerate(files)}
    with claim_folder(out), claimed_scans(out / MANIFEST, facts) as left_out:
        told_labels, missing = layout.keeps_labels, _missing(out, files)
        told = _told_notes(source, scans.notes, set())
        with reporting.progress("exporting", len(files), len(files) - len(missing)) as progress:
            for index in missing:
                try:
                    layout.write(files[index], scan := read(index))
                except ScanError as error:
                    if config.bad_scans == "refuse":
                        raise
                    reporting.message(f"left out: {error}")
                    left_out.add(files[index])
                else:
                    told_labels = told_labels or tell_labels_lost(scan.label is not None, files[index])
                    told = _told_notes(scan.source, scan.notes, told)
                progress.advance(1)
        return _number_written(source, len(files), len(left_out))


def _number_written(source: str, files: int, left_out: int) -> int:
    if left_out == files:
        raise DataError(f"no usable scan in {source}", "at least one", "see the messages above")
    return files - left_out


class _Changed:
    """Scans after some work, of which the first is told about."""

    def __init__(self, scans: NamedScans, change: Rescan | UndoMotion) -> None:
        self._scans, self._change, self._told = scans, change, False

    def __call__(self, index: int) -> Scan:
        """Return one scan after the work."""
        changed = self._change(self._scans.timed(index))
        if not self._told:
            reporting.message(f"{printable(changed.scan.source)}: {changed.told}")
            self._told = True
        return changed.scan


def _told_notes(of: str, notes: Sequence[str], told: set[str]) -> set[str]:
    """Report notes that were not told yet, and return all that were."""
    for note in notes:
        if note not in told:
            reporting.message(f"{printable(of)}: {note}")
    return told | {*notes}


def _missing(out: Path, files: Sequence[str]) -> list[int]:
    """Return which files are still to be written.

    Raises:
        OutputError: a link in place of one: what it leads to is not of this command, and would count as written.
    """
    if link := next((out / file for file in files if (out / file).is_symlink()), None):
        raise OutputError(f"{link}, which is a link", "a file of this command, or none", "remove the link")
    return [at for at, file in enumerate(files) if not (out / file).exists()]


def check_names(source: str, names: Sequence[str]) -> None:
    """Raise DataError if several scans of a source have one name, or would be one file: the last would replace others.

    Args:
        names: name or file of each scan.
    """
    if twice := sorted(name for name, count in Counter(names).items() if count > 1):
        got = f"several scans of {source} that would be {twice[0]}"
        raise DataError(got, "a name for each scan, as each becomes a file", "rename some, or take their folders apart")


def tell_labels_lost(lost: bool, file: str) -> bool:
    """Tell, if labels are lost, that a file by its ending keeps none; return whether it was told."""
    if lost:
        reporting.message(f"{Path(file).suffix} keeps no labels; --format {TREE} or npz keeps them")
    return lost


def write_array(path: Path, pixels: Float[Tensor, "H W"]) -> None:
    """Write one value for each pixel as ``.npy``."""
    with atomic_path(path) as unfinished, unfinished.open("wb") as file:
        np.save(file, pixels.cpu().numpy())


def _open(source: str, config: DataConfig, sensor: SensorModel | None) -> tuple[NamedScans, dict[str, Any]]:
    """Return the scans of a source, and the sensor as an entry of the manifest where the source does not name it."""
    opened = open_source(source, config.bad_points)
    of_files = isinstance(opened, ImageFileSource)
    if sensor is not None and not of_files:
        wanted = "range images in .npy files, which do not name their sensor"
        got = f"--sensor {sensor.name} for {source}, which holds {opened.kind}"
        raise ConfigError(got, wanted, "leave --sensor out: the points are as the source has them")
    scans = named_scans(opened, config, sensor)
    return scans, {"sensor": scans.images.sensor.to_json()} if of_files and isinstance(scans, ImageScans) else {}


class _Flat:
    """Files of one format, in folders as the scans' names have them."""

    def __init__(self, out: Path, form: type[ScanFormat], suffix: str) -> None:
        self._out, self._form, self._suffix = out, form, suffix
        self.keeps_labels = "label" in form.keeps

    def files(self, names: list[str]) -> list[str]:
        """Return the file of every scan, below the folder."""
        return [name + self._suffix for name in names]

    def write(self, file: str, scan: Scan) -> None:
        self._form.write(self._out / file, scan)


class KittiTree:
    """The tree of KITTI odometry, with labels as SemanticKITTI has them.

    Args:
        out: folder of the tree.
    """

    keeps_labels = True

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


def write_with_labels(path: Path, scan: Scan) -> None:
    """Write a scan into a file of KITTI odometry's tree, and its labels, if it has any, into that beside it."""
    if scan.label is not None:  # before the points, whose file says that the scan is complete
        with atomic_path(path.parents[1] / "labels" / f"{path.stem}.label") as temporary:
            temporary.write_bytes(scan.label.numpy().astype("<u4").tobytes())
    KittiBin.write(path, scan)


def writable_format(kind: str, *others: str) -> tuple[type[ScanFormat], str]:
    """Return the format of a name or an ending, and the ending of its files.

    Args:
        kind: name or ending.
        others: words that the command takes besides, to be named in the message.

    Raises:
        UnknownNameError: no such format, or one that cannot be written.
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


@contextmanager
def claimed_scans(manifest: Path, facts: dict[str, Any]) -> Iterator[set[str]]:
    """Write the manifest of a folder of scans, or add to the one that the same command wrote before.

    Yields a set for the files that are left out after all: at the end the manifest lists them no more.

    A new manifest is removed again if no scan was written after all; see
    :func:`~lidargrit.core.files.claimed_manifest`.

    Args:
        manifest: file in the folder that says how its scans were made.
        facts: entries of the manifest; under ``scans`` the identity of the scan in each file, below the folder.

    Raises:
        OutputError: the folder holds something else, or another scan in one of the files.
    """
    with claimed_manifest(manifest):
        _claim(manifest, facts)
        left_out = set[str]()
        yield left_out
        if left_out:
            there = read_json(manifest)
            kept = {file: name for file, name in there["scans"].items() if file not in left_out}
            write_json(manifest, {**there, "scans": kept})


def _claim(manifest: Path, facts: dict[str, Any]) -> None:
    """Write the manifest, or add to the one that is there."""
    out = manifest.parent
    for file in facts["scans"]:
        parts = PurePosixPath(file).parts
        if PurePosixPath(file).is_absolute() or ".." in parts or any(map(is_partial, parts)):
            raise OutputError(f"a scan that would lie outside, in {file}", "names below a folder", "rename it")
        user_path(str((out / file).absolute()), OutputError)  # refuses names that no file can have
    if is_taken(out) and not manifest.is_file():
        got = f"{out}, which is not empty and holds no {manifest.name}"
        raise OutputError(got, "an empty folder, or one that this very command began", "choose another one")
    if manifest.is_file():
        there = read_json(manifest)
        known = there.get("scans")
        if not isinstance(known, dict):
            raise OutputError(f"{manifest}, which lists no scans", "what lidargrit wrote", "choose another folder")
        if other := [name for name in sorted({*there, *facts} - {"scans"}) if there.get(name) != facts.get(name)]:
            raise OutputError(
                f"{out}, whose {manifest.name} has another {other[0]!r}",
                "an empty folder, or one that this very command began",
                "choose another folder",
            )
        changed = [file for file, name in facts["scans"].items() if known.get(file, name) != name]
        if changed:
            raise OutputError(
                f"{out}, where {changed[0]} is another scan of {facts['source']}",
                "as many scans as before",
                "choose another folder",
            )
        if facts["scans"].keys() <= known.keys():
            return
        facts = {**facts, "scans": {**known, **facts["scans"]}}
    write_json(manifest, facts)
