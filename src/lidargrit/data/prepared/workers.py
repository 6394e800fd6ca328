"""Shards of a prepared folder, made by several processes: ``python -m lidargrit.data.prepared FOLDER PARENT SHARD...``.

These are commands of their own and not a pool of multiprocessing: they need only the plan in the folder, the caller's
script needs no guard against being imported again, and they end when the caller dies.
"""

import json
import os
import queue
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from lidargrit.core import errors, reporting
from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import DataError, HeldError, LidarGritError, OutputError, ScanError
from lidargrit.core.files import claim_folder, write_json
from lidargrit.core.processes import module_command
from lidargrit.core.shares import each_done
from lidargrit.data.datasets import ScanDataset, open_dataset
from lidargrit.data.prepared.arrays import ImageArrays, facts_of, stored
from lidargrit.data.prepared.plan import ARRAYS, STORED_AS, MadeScans, PreparedSpec, made_name, pixels_name
from lidargrit.data.prepared.prepared import PreparedFolder
from lidargrit.scans.projection import project, variant_named
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage

_WAIT_S = 0.5  # before looking again whether a shard is there that another process makes
_KEEP_EVERY_S = 5.0  # what a killed process loses at most; a shard of real scans takes about as long


def make_shards(
    folder: Path, spec: PreparedSpec, shards: list[int], dataset: ScanDataset, workers: int, ray: str = ""
) -> None:
    """Make shards, in this process if one is enough, else in several; shards that another machine makes are waited for.

    Args:
        shards: numbers of the shards that are missing, in the order in which this machine takes them.
        ray: address of a Ray cluster that makes them, a task each.
    """
    total = sum(len(spec.scans_of(shard)) for shard in shards)
    workers = min(workers, len(shards))
    with reporting.progress("projecting scans", spec.num_scans, spec.num_scans - total) as progress:
        if ray:
            for count in each_done(partial(_make_one, folder), shards, ray=ray):
                progress.advance(count)
            return
        if workers <= 1:
            _make_free_shards(folder, spec, shards, dataset, progress.advance)
            return
        starts = [len(shards) * number // workers for number in range(workers)]
        for count in _made_by_processes(folder, [shards[start:] + shards[:start] for start in starts]):
            progress.advance(count)


def _make_free_shards(
    folder: Path,
    spec: PreparedSpec,
    shards: list[int],
    dataset: ScanDataset,
    advance: Callable[[int], None],
    is_wanted: Callable[[], bool] = lambda: True,
) -> None:
    """Make each shard that nobody else is making, until all are there: that of a process that died is free again."""
    files = PreparedFolder(str(folder))
    while shards := files.missing(spec, shards):
        is_waiting = True
        for shard in shards:
            if not is_wanted():
                return
            with suppress(HeldError), claim_folder((folder / made_name(shard)).with_suffix("")):
                if files.missing(spec, [shard]):
                    make_shard(folder, spec, shard, dataset, advance)
                is_waiting = False
        time.sleep(_WAIT_S if is_waiting else 0)


def _make_one(folder: Path, shard: int) -> int:
    """Make one shard of a folder by its plan, unless it is there, and return the number of its scans."""
    spec = PreparedFolder(str(folder)).read_spec()
    _make_free_shards(folder, spec, [shard], _dataset_of(spec.source, spec.bad_points), lambda _: None)
    return len(spec.scans_of(shard))


@lru_cache(maxsize=1)  # for all shards that a worker makes: a data set may have a million files
def _dataset_of(source: str, bad_points: str) -> ScanDataset:
    return open_dataset(source, "drop" if bad_points == "drop" else "refuse")


def make_shard(
    folder: Path, spec: PreparedSpec, shard: int, dataset: ScanDataset, advance: Callable[[int], None]
) -> None:
    """Project the scans of one shard; go on from what an interrupted process has kept of it.

    Args:
        spec: description of what the folder will hold.
        shard: number of the shard.
        dataset: source of the scans.
        advance: function that receives the number of further scans done.
    """
    wanted = evenly_spaced(spec.max_scans or len(dataset), len(dataset))
    if len(wanted) != spec.num_scans:
        raise DataError(f"{len(wanted)} scans in {spec.source}", f"the {spec.num_scans} planned", "prepare again")
    sensor, writer = SensorModel.from_json(spec.sensor), ShardWriter(folder, spec, shard)
    advance(len(writer.scans))
    kept_at = time.monotonic()
    for index in sorted(set(spec.scans_of(shard)) - writer.scans):
        try:
            scan = dataset.scan(wanted[index])
            image = project(scan, sensor, variant=variant_named(spec.variant))
        except ScanError as error:
            wrong = error.as_left_out()
            if spec.bad_scans == "refuse":
                leave_out = "leave such scans out by --bad-scans skip"
                raise ScanError(wrong.got, wrong.wanted, f"{wrong.cure}, or {leave_out}") from None
            writer.leave_out(index, str(wrong))
        else:
            writer.add(index, image, scan.full_scale)
        advance(1)
        if time.monotonic() - kept_at > _KEEP_EVERY_S:
            writer.keep()
            kept_at = time.monotonic()
    writer.keep()


class ShardWriter:
    """Images of one shard, collected in memory and now and then written; it goes on from what is there already.

    Args:
        spec: plan of the folder.
        shard: number of the shard.
    """

    def __init__(self, folder: Path, spec: PreparedSpec, shard: int) -> None:
        self._path, self._spec = folder / made_name(shard), spec
        self._files = {name: folder / pixels_name(name, shard) for name in STORED_AS}
        self._arrays = ImageArrays(str(folder), spec)
        kept, self._waiting = PreparedFolder(str(folder)).kept(shard), dict[int, dict[str, np.ndarray]]()
        self._made = kept if set(kept.scans) <= set(spec.scans_of(shard)) else MadeScans()
        if not self._made.scans:  # what is there may be damaged, and could not be added to
            for file in self._files.values():
                file.unlink(missing_ok=True)

    @property
    def scans(self) -> set[int]:
        """Indices of the scans that have been added or left out."""
        return set(self._made.scans)

    def add(self, scan: int, image: RangeImage, full_scale: int = 0) -> None:
        """Add the image of a scan; for ``full_scale`` see :class:`lidargrit.data.prepared.plan.ImageFacts`."""
        self._waiting[scan] = planes = stored(image, self._spec.range_step_m)
        self._made.images.append(facts_of(scan, planes, full_scale))

    def leave_out(self, scan: int, why: str) -> None:
        """Note that a scan cannot be used."""
        self._made.left_out[scan] = why

    def keep(self) -> None:
        """Write what was added: first the pixels, then the file by which they count."""
        try:
            if self._waiting:
                self._write_waiting()
        except OSError as error:
            wanted, cure = "a folder with room that may be written to", "free some space, then give the command again"
            raise OutputError(f"'{error}' while writing {self._path.parent.parent}", wanted, cure) from None
        self._made.file_bytes = {name: file.stat().st_size for name, file in self._files.items() if file.is_file()}
        write_json(self._path, asdict(self._made))

    def _write_waiting(self) -> None:
        group = self._path.parent.parent / ARRAYS / "zarr.json"
        if not group.is_file():
            write_json(group, {"zarr_format": 3, "node_type": "group", "attributes": {"sensor": self._spec.sensor}})
        first, last = min(self._waiting), max(self._waiting)
        planes = dict[str, np.ndarray]()
        for scan, of_image in self._waiting.items():
            for name, pixels in of_image.items():
                if name not in planes:
                    planes[name] = np.zeros((last - first + 1, *pixels.shape), pixels.dtype)
                planes[name][scan - first] = pixels
        self._arrays.write(first, planes)
        self._waiting = {}


def _made_by_processes(folder: Path, shares: list[list[int]]) -> Iterator[int]:
    """Start processes that make shards, and yield the numbers of further scans done."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}  # one core each: threads of several would fight for them
    command = module_command("lidargrit.data.prepared", str(folder), str(os.getpid()))
    processes: list[subprocess.Popen[str]] = []
    lines: queue.Queue[str | int] = queue.Queue()
    try:
        for share in shares:
            # A group of their own: Ctrl-C is for this process, which ends them.
            process = subprocess.Popen(
                [*command, *map(str, share)], stdout=subprocess.PIPE, text=True, env=environment, process_group=0
            )
            processes.append(process)
            threading.Thread(target=_listen, args=(process, lines), daemon=True).start()
        running = len(processes)
        while running:
            line = lines.get()
            if isinstance(line, int):
                running -= 1
                if line:  # it died, and the others could go on for hours
                    break
            elif line.startswith("{"):
                raise _error_of(line)
            else:
                yield int(line)
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait()
    if any(process.returncode for process in processes):
        raise DataError("a process that died while projecting scans", "all to end well", "the same command goes on")


def _listen(process: subprocess.Popen[str], lines: queue.Queue[str | int]) -> None:
    assert process.stdout is not None
    with process.stdout:
        for line in process.stdout:
            lines.put(line)
    lines.put(process.wait())


def _error_of(line: str) -> LidarGritError:
    name, *what = json.loads(line)["error"]
    return getattr(errors, name)(*what)


def make_some_shards(folder: Path, parent: int, shards: list[int]) -> int:
    """Make shards until the parent process ends; print a line for every scan, or the error."""
    try:
        spec = PreparedFolder(str(folder)).read_spec()
        dataset = _dataset_of(spec.source, spec.bad_points)
        told = partial(print, flush=True)
        _make_free_shards(folder, spec, shards, dataset, told, lambda: os.getppid() == parent)
    except LidarGritError as error:
        print(json.dumps({"error": [type(error).__name__, error.got, error.wanted, error.cure]}), flush=True)
        return 2
    return 0
