"""Sources of scans → prepared range images, projected once by many processes, and resumed where they were stopped."""

import hashlib
import json
import time
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lidargrit.core import reporting
from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.environment import cache_folder
from lidargrit.core.errors import DataError, OutputError, counted_scans, no_usable_scan
from lidargrit.core.files import (
    claim_folder,
    claimed_manifest,
    is_taken,
    sha256_of_json,
    state_of,
    write_json,
    write_text,
)
from lidargrit.core.processes import rank_and_world_size
from lidargrit.core.version import __version__
from lidargrit.data.datasets import ScanDataset, open_dataset
from lidargrit.data.datasets.shared.streets import Streets
from lidargrit.data.prepared.arrays import range_step_m
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.prepared.imaging import choose_projection
from lidargrit.data.prepared.plan import ARRAYS, FORMAT, MADE_FOLDER, PLAN_FILE, SCANS_FILE, PreparedSpec, made_name
from lidargrit.data.prepared.prepared import PreparedFolder, PreparedImages
from lidargrit.data.prepared.workers import make_shards
from lidargrit.scans.motion import Motion
from lidargrit.scans.sensors import SensorModel, load_sensor

_SHARD_SCANS = 128  # 12 MB of KITTI-360 size images, and 625 files for 80,000 scans
_BAD = ("bad_points", "bad_scans")  # the settings that refuse what cannot be used, or leave it out


def prepare(
    source: str,
    config: DataConfig,
    folder: Path | None = None,
    sensor: SensorModel | None = None,
    rank: int | None = None,
    world_size: int | None = None,
    dataset: ScanDataset | None = None,
    ray: str = "",
) -> Path:
    """Project every scan of a source into a folder of shards; shards that are there already are kept.

    Args:
        config: settings by which scans become images, number of processes, and treatment of bad scans.
        folder: prepared folder; if not given, one in the cache, named by everything that the pixels depend on.
        sensor: sensor of the images, in place of the config's.
        rank: number of this machine, from 0: machines begin at different shards, and each takes what is free until all
            are there. If not given, the environment's ``RANK``, else 0.
        world_size: number of machines that share the work; if not given, the environment's ``WORLD_SIZE``, else 1.
        dataset: data set of the source, where it is open already.
        ray: address of a Ray cluster that projects in place of processes; see :func:`each_done`.

    Returns:
        the folder, complete.
    """
    sensor = sensor or config.load_sensor()
    rank, world_size = rank_and_world_size(rank, world_size)
    dataset = open_dataset(source, config.bad_points) if dataset is None else dataset
    spec, scans = _spec(source, dataset, sensor, config)
    # By all but the source's name: the digest names the scans.
    folder = folder or cache_folder() / sha256_of_json({**asdict(spec), "source": ""})[:24]
    _claim(folder, spec, scans)
    missing = PreparedFolder(str(folder)).missing(spec, range(spec.num_shards))
    if not missing:  # a complete folder may be one that this user can only read
        return folder
    try:
        with claim_folder(folder, shared=True):  # with other machines, and with whoever needs the same cache
            if not (folder / PLAN_FILE).exists():  # another machine has failed meanwhile, and taken its plan back
                _claim(folder, spec, scans)
            first = len(missing) * rank // world_size
            make_shards(folder, spec, missing[first:] + missing[:first], dataset, config.workers, ray)
    except BaseException:
        _take_back(folder)
        raise
    finally:
        with suppress(OutputError, OSError), claim_folder(folder):  # nobody else writes
            _sweep(folder)
    return folder


@dataclass(frozen=True)
class PrepareReport:
    """Size and content of a prepared folder.

    Args:
        columns: number of fine columns of an image.
        size: size of all shards, in bytes.
        seconds: time that the preparation took, in seconds.
        left_out: reasons why scans were left out, one line for each scan.
    """

    folder: Path
    images: int
    rows: int
    columns: int
    size: int
    seconds: float
    left_out: tuple[str, ...]

    def as_text(self) -> str:
        """Return all of it as a line for a person."""
        return (
            f"{self.images} range images of {self.rows}x{self.columns} in {self.folder}: "
            f"{self.size / 1e6:.1f} MB, {self.size / 1e3 / max(self.images, 1):.0f} KB each, in {self.seconds:.1f} s"
            + (f"; {counted_scans(len(self.left_out))} left out" if self.left_out else "")
        )

    def to_json(self) -> dict[str, Any]:
        """Return all of it as plain values."""
        return {**vars(self), "folder": str(self.folder), "left_out": list(self.left_out)}


def prepare_and_describe(
    source: str,
    dataset: ScanDataset,
    config: DataConfig,
    folder: Path | None,
    rank: int | None = None,
    world_size: int | None = None,
    verify: bool = False,
    ray: str = "",
) -> PrepareReport:
    """Prepare a source and return what the folder holds.

    Args:
        source, dataset, config, folder, rank, world_size, ray: the arguments of :func:`prepare`.
        verify: whether to read every image back and make damaged shards again.
    """
    begun = time.monotonic()
    imaging = choose_projection(source, dataset, config.load_sensor(), config)
    imaging.report()
    config, sensor = imaging.config, imaging.sensor
    folder = prepare(source, config, folder, sensor, rank, world_size, dataset, ray)
    if verify and (damaged := damaged_shards(folder, rank, world_size)):
        reporting.message(f"damaged and made again: shards {', '.join(map(str, damaged))}")
        for shard in damaged:
            (folder / made_name(shard)).unlink(missing_ok=True)  # another process may have removed it
        prepare(source, config, folder, sensor, rank, world_size, dataset, ray)
    images, seconds = PreparedImages(str(folder)), time.monotonic() - begun
    for remark in images.remarks():
        reporting.message(remark)
    if not len(images):
        raise no_usable_scan(source)
    size = sum(path.stat().st_size for path in (folder / ARRAYS).rglob("*") if path.is_file())
    shape = images.sensor.height, images.sensor.width
    return PrepareReport(folder, len(images), *shape, size, seconds, tuple(images.left_out.values()))


def damaged_shards(folder: Path, rank: int | None = None, world_size: int | None = None) -> list[int]:
    """Read every image of this machine's shards of a prepared folder, and return the numbers of damaged shards.

    A machine does not look at the shards of others: these may be making a damaged one again at this moment.
    """
    rank, world_size = rank_and_world_size(rank, world_size)
    images = PreparedImages(str(folder))
    mine = [index for index in range(len(images)) if images.shard_of(index) % world_size == rank]
    damaged: set[int] = set()
    with reporting.progress("verifying", len(mine)) as progress:
        for index in mine:
            try:
                images.read(index, verify=True)
            except DataError:
                damaged.add(images.shard_of(index))
            progress.advance(1)
    return sorted(damaged)


def _spec(
    source: str, dataset: ScanDataset, sensor: SensorModel, config: DataConfig
) -> tuple[PreparedSpec, list[tuple[Any, ...]]]:
    """Return the specification of the folder, and of every scan its name, drive, and its file's size and time.

    Where they are known, the time and the pose of the scan follow.
    """
    fine, scans, beside = sensor.fine(), [], []
    for index in evenly_spaced(config.max_scans or len(dataset), len(dataset)):
        path = dataset.path(index)
        state = None if path is None else state_of(path)
        if path is not None and state is None and config.bad_scans == "refuse":  # else left out when it is read
            raise DataError(f"{path}, which cannot be read", "files that are there", "remove the link")
        name = dataset.name(index) if path is None else f"{path.resolve()}{dataset.within(index)}"
        scans.append((name, dataset.recording(index), *(state or (0, 0)), *_time_and_pose(dataset, index)))
        known = ((other.name, state_of(other)) for other in dataset.sidecar_files(index))
        beside += [(other, *state) for other, state in known if state]
    others = json.dumps(beside) if beside else ""
    # The sensor by which scans are simulated is in no name of theirs, and its file may change.
    if isinstance(dataset, Streets) and dataset.sensor != Streets.sensor:
        others += json.dumps(load_sensor(dataset.sensor).to_json())
    spec = PreparedSpec(
        format=FORMAT,
        version=__version__,
        source=source,
        sensor=fine.to_json(),
        variant=config.projection_variant,
        bad_points=config.bad_points,
        bad_scans=config.bad_scans,
        max_scans=config.max_scans,
        range_step_m=range_step_m(fine),
        shard_scans=_SHARD_SCANS,
        num_scans=len(scans),
        digest=hashlib.sha256((json.dumps(scans) + others).encode()).hexdigest(),
    )
    return spec, scans


def _time_and_pose(dataset: ScanDataset, index: int) -> tuple[float, list[float] | None] | tuple[()]:
    """Return the time and the pose of a scan as numbers; nothing where the time is not known.

    Damaged files of poses count as none: images without a past need no pose.
    """
    motion = Motion()
    with suppress(DataError):
        motion = dataset.motion(index)
    if motion.time_s is None:
        return ()
    return motion.time_s, None if motion.pose is None else motion.pose.flatten().tolist()


def _claim(folder: Path, spec: PreparedSpec, scans: list[tuple[Any, ...]]) -> None:
    """Write the plan into a free folder, or check that the folder's plan is the same."""
    listing, path = json.dumps(scans), folder / SCANS_FILE
    if (folder / PLAN_FILE).exists():
        planned = PreparedFolder(str(folder)).read_spec()
        # The digest tells whether these are other scans; the same folder may be named in another way.
        differing = [name for name in spec.differences(planned) if name != "source"]
        # No scan was left out so far, and none was bad, so all that is there is as a more lenient treatment has it.
        lenient = planned.bad_scans == "refuse" and all(
            name in _BAD and getattr(planned, name) == "refuse" for name in differing
        )
        if differing and not lenient:
            raise OutputError(
                f"{folder}, which is stale: prepared with {_other(differing)}",
                "an empty folder, or what was prepared from these very scans in this very way",
                "prepare into another folder, or remove this one",
            )
        with nullcontext() if differing else suppress(OutputError):  # a complete folder may not be ours to change
            if spec != planned:
                write_json(folder / PLAN_FILE, asdict(spec))
            if not path.is_file() or path.read_bytes() != listing.encode():  # damaged: the plan's digest is of the list
                write_text(path, listing)
        return
    # In this order: another process may be claiming the folder for the same scans at this moment.
    if is_taken(folder) and not (path.is_file() and path.read_bytes() == listing.encode()):
        raise OutputError(f"{folder}, which holds something else", "an empty folder", "choose another one")
    with claim_folder(folder, shared=True), claimed_manifest(path):  # on a full disk neither is left
        write_text(path, listing)
        write_json(folder / PLAN_FILE, asdict(spec))  # last: it says that the folder is ours


def _sweep(folder: Path) -> None:
    """Remove what processes that were killed have left: locks of shards, and files of the library half-written."""
    for shard in filter(Path.is_dir, (folder / MADE_FOLDER).glob("*")):
        shard.rmdir()
    for left in (folder / ARRAYS).rglob("*.__lock"):
        left.unlink()


def _take_back(folder: Path) -> None:
    """Remove a plan of which nothing has been made, so that a corrected command is not refused as another.

    A machine that still works by the plan holds the folder, and keeps it.
    """
    with suppress(OutputError, OSError), claim_folder(folder):
        if not (folder / ARRAYS).exists():
            if (folder / MADE_FOLDER).is_dir():
                (folder / MADE_FOLDER).rmdir()
            for name in (PLAN_FILE, SCANS_FILE):
                (folder / name).unlink(missing_ok=True)


def _other(differing: Sequence[str]) -> str:
    """Name what differs between two plans in words for a person."""
    settings = [f"another {name}" for name in differing if name not in ("digest", "num_scans")]
    return ", ".join([*settings, *(["other scans"] if len(settings) < len(differing) else [])])
