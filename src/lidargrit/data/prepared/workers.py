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
from pathlib import Path

from lidargrit.core import errors, reporting
from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import DataError, LidarGritError, ScanError
from lidargrit.core.processes import module_command
from lidargrit.data.datasets import ScanDataset, open_dataset
from lidargrit.data.prepared.prepared import PreparedFolder, PreparedSpec, shard_name, unfinished_name
from lidargrit.data.prepared.shards import LocalBytes, ShardWriter
from lidargrit.scans.projection import project
from lidargrit.scans.sensors import SensorModel

_KEEP_EVERY_S = 5.0  # what a killed process loses at most; a shard of real scans takes about as long


def make_shards(folder: Path, spec: PreparedSpec, shards: list[int], dataset: ScanDataset, workers: int) -> None:
    """Make shards, in this process if one is enough, else in several."""
    total = sum(len(spec.scans_of(shard)) for shard in shards)
    workers = min(workers, len(shards))
    with reporting.progress("projecting scans", spec.num_scans, spec.num_scans - total) as progress:
        if workers <= 1:
            for shard in shards:
                make_shard(folder, spec, shard, dataset, progress.advance)
            return
        for count in _made_by_processes(folder, [shards[first::workers] for first in range(workers)]):
            progress.advance(count)


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
    sensor = SensorModel.from_json(spec.sensor)
    unfinished, writer = folder / unfinished_name(shard), ShardWriter(spec.range_step_m)
    with suppress(OSError, ValueError):  # not there, or damaged
        writer.add_from(LocalBytes(unfinished), unfinished.name)
    advance(len(writer.scans))
    kept_at = time.monotonic()
    for index in sorted(set(spec.scans_of(shard)) - writer.scans):
        try:
            scan = dataset.scan(wanted[index])
            image = project(scan, sensor, variant="reference" if spec.variant == "reference" else "exact")
        except ScanError as error:
            if spec.bad_scans == "refuse":
                leave_out = "leave such scans out by --bad-scans skip"
                raise ScanError(error.got, error.wanted, f"{error.cure}, or {leave_out}") from None
            writer.leave_out(index, str(error))
        else:
            writer.add(index, image, scan.full_scale)
        advance(1)
        if time.monotonic() - kept_at > _KEEP_EVERY_S:
            writer.write(unfinished)
            kept_at = time.monotonic()
    writer.write(folder / shard_name(shard))
    unfinished.unlink(missing_ok=True)


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
        dataset = open_dataset(spec.source, "drop" if spec.bad_points == "drop" else "refuse")
        for shard in shards:
            if os.getppid() != parent:
                return 1  # whoever wanted the shards is gone
            make_shard(folder, spec, shard, dataset, lambda count: print(count, flush=True))
    except LidarGritError as error:
        print(json.dumps({"error": [type(error).__name__, error.got, error.wanted, error.cure]}), flush=True)
        return 2
    return 0
