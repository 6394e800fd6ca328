"""Scans for other programs: samples, prepared scans or a data set → files of points, a KITTI tree, or recordings."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from lidargrit.core import reporting
from lidargrit.core.errors import ConfigError, ScanError, printable
from lidargrit.data.formats import ScanFormat
from lidargrit.data.prepared.config import DEFAULTS, DataConfig
from lidargrit.data.recordings import KINDS, recording_of, write_recording
from lidargrit.data.scan_folder import TREE, KittiTree, ScanFolder, ScanIdentity, writable_format
from lidargrit.data.sources import open_source
from lidargrit.data.sources.image_files import ImageFileSource
from lidargrit.data.sources.named import ImageScans, NamedScans, named_scans
from lidargrit.scans.many_scans import leaving_out
from lidargrit.scans.rescan import Rescan
from lidargrit.scans.sensors import SensorModel, load_sensor
from lidargrit.scans.types import Scan
from lidargrit.scans.undo_motion import UndoMotion

MANIFEST = "export.json"


def export_scans(
    source: str,
    out: Path,
    kind: str,
    config: DataConfig = DEFAULTS,
    sensor: SensorModel | None = None,
    change: Rescan | UndoMotion | None = None,
) -> int:
    """Write every scan of a source to a file of its own, or every drive to a recording; what is there is kept.

    Scans keep their own points; a range image gives one point for each return, on the ray of its pixel. Files have the
    names of the scans, or ``NNNNNN``, the index, for samples and prepared scans. ``export.json`` says which file holds
    which scan, and ``sensor.json`` on which rays points lie, if that is known, unless such files are read
    as of that sensor anyway.

    Args:
        source: samples of ours or of another program, a prepared folder, or a source of scans.
        out: an empty folder, or one that the same command began; more scans can be added to it.
        kind: a format's name or one of its endings ("pcd", "npz", ...), or ``kitti_odometry`` for the tree
            ``sequences/SS/velodyne/NNNNNN.bin``, with SemanticKITTI's ``labels/NNNNNN.label`` where scans have labels,
            and ``poses.txt``, ``times.txt`` and ``calib.txt`` where times and poses are known;
            ``mcap`` or ``rrd`` for a recording of each folder of scans, with their times and poses.
        config: number of scans, and what to do with unusable points and scans; nothing else of it is used.
        sensor: sensor of range images that do not name theirs, as ``.npy``; no other source takes one.
        change: work on each scan before it is written; scans stay as they are if not given.

    Returns:
        Number of scans, or of recordings, that are there now.
    """
    others = TREE, *KINDS
    layout = KittiTree(out) if kind in others else _Flat(out, *writable_format(kind, *others))
    scans, of_images = _open(source, config, sensor)
    read = (scans.timed if kind in KINDS else scans.scan) if change is None else _Changed(scans, change)
    scans.check_output(out)
    facts = {"source": source, "format": kind, **of_images, **(change.identity() if change else {})}
    if kind in KINDS:
        return _Recordings(scans, read, kind, config).write(out, facts)
    files = layout.files([scans.name(index) for index in range(len(scans))])
    identities = [scans.identity(index) for index in range(len(scans))]
    folder = ScanFolder(out, MANIFEST, facts, files, identities, config.bad_scans)
    sensor = change.other if isinstance(change, Rescan) else scans.sensor()
    is_read_so = sensor is not None and layout.sensor and load_sensor(layout.sensor).to_json() == sensor.to_json()
    with folder.writing("exporting") as progress:
        for index in folder.missing:
            with folder.leaving_out(index):
                scan = read(index)
                if sensor is not None and not is_read_so:  # a folder without any scan is left free
                    folder.tell_sensor(sensor)
                layout.write(files[index], scan)
                if scan.label is not None and not layout.keeps_labels:
                    folder.tell_labels_lost(files[index])
                scans.tell_notes(scan)
            progress.advance(1)
    if isinstance(layout, KittiTree):
        motions = [scan.motion for scan in scans.timed_scans()]
        changed = motions if change is None else [one._replace(pose=change.pose(one.pose)) for one in motions]
        layout.write_motions(files, changed)
    return folder.num_written


class _Recordings:
    """Scans of a source as recordings, one for each folder of scans.

    Args:
        read: function that reads a scan, with its time and pose where they are known.
    """

    def __init__(self, scans: NamedScans, read: Callable[[int], Scan], kind: str, config: DataConfig) -> None:
        self._scans, self._read, self._kind, self._config = scans, read, kind, config
        self._drives: dict[str, list[int]] = {}
        for index in range(len(scans)):
            self._drives.setdefault(recording_of(scans.name(index)), []).append(index)

    def write(self, out: Path, facts: dict[str, Any]) -> int:
        """Write those that are missing, and return the number of recordings that are there then."""
        names = ("scans" if drive == "." else drive for drive in self._drives)
        files, drives = [f"{name}.{self._kind}" for name in names], [*self._drives.values()]
        each = [[self._scans.identity(index) for index in drive] for drive in drives]
        holds = [ScanIdentity(" ".join(one.name for one in of), "; ".join(one.state for one in of)) for of in each]
        folder = ScanFolder(out, MANIFEST, facts, files, holds, self._config.bad_scans)
        left = sum(len(drives[number]) for number in folder.missing)
        with folder.writing("exporting", left, len(self._scans)) as progress:
            for number in folder.missing:
                with folder.leaving_out(number):
                    usable = self._usable(drives[number], progress.advance)
                    write_recording(out / files[number], self._kind, usable)
        return folder.num_written

    def _usable(self, drive: list[int], advance: Callable[[int], None]) -> Iterator[Scan]:
        is_empty = True
        for index in drive:
            with leaving_out(self._config.bad_scans == "skip"):
                scan = self._read(index)
                self._scans.tell_notes(scan)
                is_empty = False
                yield scan
            advance(1)
        if is_empty:
            raise ScanError(f"no usable scan of {self._scans.name(drive[0])}", "at least one", "leave the drive out")


class _Changed:
    """Scans after some work, of which the first is told about."""

    def __init__(self, scans: NamedScans, change: Rescan | UndoMotion) -> None:
        self._scans, self._change, self._told = scans, change, False

    def __call__(self, index: int) -> Scan:
        changed = self._change(self._scans.timed(index))
        if not self._told:
            reporting.message(f"{printable(changed.scan.source)}: {changed.told}")
            self._told = True
        return changed.scan


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
        self.keeps_labels, self.sensor = form.keeps_labels(suffix), form.sensor

    def files(self, names: list[str]) -> list[str]:
        return [name + self._suffix for name in names]

    def write(self, file: str, scan: Scan) -> None:
        self._form.write(self._out / file, scan)
