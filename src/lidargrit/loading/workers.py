"""Shards of a plan, made by several processes at once: ``python -m lidargrit.loading FOLDER PARENT SHARD...``.

Processes of their own rather than a pool: they need nothing but the plan in the folder, a caller's script needs no
guard against being imported again, and none is left at work when the caller dies.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

from lidargrit import errors
from lidargrit.datasets import ScanDataset, open_dataset
from lidargrit.determinism import evenly_spaced
from lidargrit.errors import DataError, LidarGritError, ScanError
from lidargrit.files import atomic_path
from lidargrit.loading.prepared import PreparedFolder, PreparedSpec, shard_name
from lidargrit.loading.shards import ShardWriter
from lidargrit.processes import module_command
from lidargrit.projection import project
from lidargrit.reporting import Reporter
from lidargrit.sensors import SensorModel


def make_shards(
    folder: Path, spec: PreparedSpec, shards: list[int], dataset: ScanDataset, workers: int, reporter: Reporter
) -> None:
    """Make shards, in this process if there is one only, else in as many as are wanted.

    Raises:
        LidarGritError: what one of the processes met; the others are stopped.
    """
    total = sum(len(spec.scans_of(shard)) for shard in shards)
    done = spec.num_scans - total
    with reporter.progress("projecting scans", spec.num_scans, done) as progress:
        if min(workers, len(shards)) <= 1:
            for shard in shards:
                make_shard(folder, spec, shard, dataset)
                progress.advance(len(spec.scans_of(shard)))
            return
        for shard in _made_by_processes(folder, [shards[first::workers] for first in range(min(workers, len(shards)))]):
            progress.advance(len(spec.scans_of(shard)))


def make_shard(folder: Path, spec: PreparedSpec, shard: int, dataset: ScanDataset) -> None:
    """Project the scans of one shard.

    Raises:
        ScanError: a scan that cannot be used, unless such scans are skipped.
        DataError: the source no longer holds the scans that were planned.
    """
    wanted = evenly_spaced(spec.max_scans or len(dataset), len(dataset))
    if len(wanted) != spec.num_scans:
        raise DataError(f"{len(wanted)} scans in {spec.source}", f"the {spec.num_scans} planned", "prepare again")
    sensor = SensorModel.from_json(spec.sensor)
    with atomic_path(folder / shard_name(shard)) as temporary, temporary.open("wb") as file:
        writer = ShardWriter(file, spec.range_step_m)
        for index in spec.scans_of(shard):
            try:
                scan = dataset.scan(wanted[index])
                image = project(scan, sensor, variant="reference" if spec.variant == "reference" else "exact")
            except ScanError as error:
                if spec.bad_scans == "refuse":
                    leave_out = "leave such scans out by --set data.bad_scans=skip (train) or --bad-scans skip"
                    raise ScanError(error.got, error.wanted, f"{error.cure}, or {leave_out}") from None
                writer.leave_out(index, str(error))
            else:
                writer.add(index, image)
        writer.finish()


def _made_by_processes(folder: Path, shares: list[list[int]]) -> Iterator[int]:
    """Yield each shard's number when it is there."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}  # one core each: threads of several would fight for them
    command = module_command("lidargrit.loading", str(folder), str(os.getpid()))
    processes = [
        subprocess.Popen([*command, *map(str, share)], stdout=subprocess.PIPE, text=True, env=environment)
        for share in shares
    ]
    told: queue.Queue[str | None] = queue.Queue()
    for process in processes:
        threading.Thread(target=_listen, args=(process, told), daemon=True).start()
    try:
        running = len(processes)
        while running:
            line = told.get()
            if line is None:
                running -= 1
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


def _listen(process: subprocess.Popen[str], told: queue.Queue[str | None]) -> None:
    assert process.stdout is not None
    with process.stdout:
        for line in process.stdout:
            told.put(line)
    told.put(None)


def _error_of(line: str) -> LidarGritError:
    name, *what = json.loads(line)["error"]
    return getattr(errors, name)(*what)


def work(folder: Path, parent: int, shards: list[int]) -> int:
    """Make shards while the process that wants them lives; print the number of each, or the error."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that a half-written shard is removed
    spec = PreparedFolder(str(folder)).read_spec()
    dataset = open_dataset(spec.source, "drop" if spec.bad_points == "drop" else "refuse")
    for shard in shards:
        if os.getppid() != parent:
            return 1  # whoever wanted the shards is gone
        try:
            make_shard(folder, spec, shard, dataset)
        except LidarGritError as error:
            print(json.dumps({"error": [type(error).__name__, error.got, error.wanted, error.cure]}), flush=True)
            return 2
        print(shard, flush=True)
    return 0
