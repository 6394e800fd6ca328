"""Scans of a user → their completions in files, which have the names of the scans."""

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import accumulate, chain, groupby, islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from lidargrit.core.determinism import derive_seed, scan_seed
from lidargrit.core.errors import ConfigError, OutputError
from lidargrit.core.shares import each_done
from lidargrit.data.formats import ScanFormat
from lidargrit.data.prepared.config import DEFAULTS, DataConfig
from lidargrit.data.scan_folder import IMAGE, TREE, KittiTree, ScanFolder, check_names, write_array
from lidargrit.data.sources.image_files import PROBABILITY
from lidargrit.inference.complete import Model, open_model
from lidargrit.inference.complete.clouds_to_files import suffix_of, write_cloud
from lidargrit.inference.complete.inputs import Inputs, InputScan, open_inputs
from lidargrit.inference.complete.tasks import Task, complete_images
from lidargrit.scans.condition import Observed
from lidargrit.scans.sensors import ProjectionOption, SensorModel
from lidargrit.scans.types import RangeImage

_FILES_AT_MOST = 400_000  # as many as the largest data set has scans; the manifest names each


@dataclass(frozen=True)
class OutputConfig:
    """Number and kind of the files that completions are written to.

    Args:
        count: number of completions of each scan.
        seed: seed of the first completion of a scan; each further completion has the next seed.
        format: name or ending of a format, ``image`` for range images (H, W) in metres as ``.npy``, or
            ``kitti_odometry`` for its tree, with SemanticKITTI's files of labels. If empty, each file has the format of
            its scan where that can be written, and ``.npz`` elsewhere.
        probability: number of samples of the mask from which ``NAME.probability.npy`` gives each pixel's share of
            returns; 0 for no such files.
    """

    count: int = 1
    seed: int = 0
    format: str = ""
    probability: int = 0


@dataclass(frozen=True)
class Written:
    """What a verb wrote.

    Args:
        scans: number of completed scans that are there now, or were written with a batch.
        points_in: number of points of the scans that were read now; 0 for range images.
        points_out: number of points of the files that were written now.
        points_filled: number of these that a model added.
    """

    scans: int
    points_in: int = 0
    points_out: int = 0
    points_filled: int = 0


@dataclass(frozen=True, eq=False)
class _Job:
    index: int
    number: int
    turn: int
    scan: InputScan
    condition: Observed
    form: type[ScanFormat] | None


@dataclass(frozen=True)
class _Work:
    """What is completed and how: all that a machine of a cluster needs to complete some of it."""

    source: str
    out: Path
    model: str
    sensor: str  # of a classical method, as JSON
    sampling: object
    projection: ProjectionOption
    device: str
    task: Task
    output: OutputConfig
    config: DataConfig


@dataclass(frozen=True, eq=False)
class _Completion:
    """The scans of a user, and the folder and the model that they are completed in and by."""

    inputs: Inputs
    folder: ScanFolder
    model: Model
    task: Task
    output: OutputConfig

    @classmethod
    def of(
        cls,
        source: str,
        out: Path,
        model: Model,
        task: Task,
        output: OutputConfig,
        config: DataConfig,
    ) -> "_Completion":
        """Open scans and folder; ``completed.json`` says how the files were made, and of which scans."""
        reader = replace(task.reader(model.sensor, model.projection_variant), projection=model.projection)
        inputs = open_inputs(source, reader, config)
        inputs.scans.check_output(out)
        files = _files(inputs, source, output)
        facts = {"verb": task.verb, "source": source, **task.identity(), **_facts(model, output)}
        identities = [inputs.scans.identity(number // output.count) for number in range(len(files))]
        folder = ScanFolder(out, "completed.json", facts, files, identities, config.bad_scans)
        return cls(inputs, folder, model, task, output)

    def write(self, jobs: Iterable[_Job]) -> "Iterator[Written]":
        """Complete scans and write them; yield what was written with each batch."""
        for batch in _batches(jobs, self.model.batch_size):
            counts = np.zeros(3, dtype=np.int64)
            for job, images in zip(batch, _completed(self.model, batch, self.output.seed), strict=True):
                counts += self._write_one(job, images)
            points_in, points_out, points_filled = counts.tolist()
            yield Written(len(batch), points_in, points_out, points_filled)

    def _write_one(self, job: _Job, images: RangeImage) -> Int64[np.ndarray, "3"]:
        folder, output = self.folder, self.output
        file = folder.files[job.index * output.count + job.turn]
        if output.probability and job.turn == 0:
            write_array(folder.out / _probability_file(file), _return_share(self.model, job, output))
        folder.tell_sensor(self.sensor_of(job), file)
        kept_labels, points = images.label is None, np.zeros(3, dtype=np.int64)
        if output.format == IMAGE:
            write_array(folder.out / file, images.range_m[0])
        else:
            kept_labels, points = _write_cloud(folder.out / file, output.format, self.task, job, images)
        if not kept_labels:
            folder.tell_labels_lost(file)
        return points

    def sensor_of(self, job: _Job) -> SensorModel:
        """Return the rays on which the pixels or points of a file lie."""
        return self.model.sensor if self.output.format == IMAGE else self.task.sensor_of_points(job.scan)

    def jobs(self, files: Sequence[int]) -> Iterator[_Job]:
        count = self.output.count
        for index, of_scan in groupby(files, lambda file: file // count):
            job = None
            with self.folder.leaving_out(*range(index * count, (index + 1) * count)):
                seen = None if self.output.format == IMAGE else partial(self.task.see, model=self.model)
                scan, number = self.inputs.read(index, seen), self.inputs.scans.number(index)
                condition = self.task.condition(scan, derive_seed(self.output.seed, number))
                job = _Job(index, number, 0, scan, condition, self.inputs.form(index))
            if job is not None:
                for file in of_scan:
                    yield replace(job, turn=file % count)


@lru_cache(maxsize=1)  # for all shares of a worker
def _completion_of(work: _Work) -> _Completion:
    sensor = SensorModel.from_json(json.loads(work.sensor)) if work.sensor else None
    model = open_model(work.model, work.task.kind, sensor, device=work.device)
    model = replace(model, sampling=work.sampling, projection=work.projection)
    return _Completion.of(work.source, work.out, model, work.task, work.output, work.config)


def _write_some(work: _Work, files: Sequence[int]) -> tuple[int, list[Written], list[int]]:
    """Write some of the files, and return how many these are, what was written, and which of them were left out."""
    completion = _completion_of(work)
    missing = [file for file in files if not (work.out / completion.folder.files[file]).exists()]
    written = [*completion.write(completion.jobs(missing))]
    return len(files), written, [file for file in files if completion.folder.is_left_out(file)]


def complete_scans(
    source: str,
    out: Path,
    model: Model,
    task: Task,
    output: OutputConfig,
    config: DataConfig = DEFAULTS,
    *,
    ray: str = "",
    device: str = "",
) -> Written:
    """Complete every scan of a source and write it; files that are there already are not written again.

    With several completions of each scan the files lie in ``out/completion_0`` and so on, each a whole set of scans.
    ``completed.json`` says how they were made, and ``sensor.json`` on which rays points lie.

    Args:
        out: an empty folder, or one that the same command began.
        model: model or classical method; see :func:`lidargrit.inference.complete.open_model`.
        task: the work on each scan.
        output: number and kind of files.
        config: number of scans, and what to do with unusable points and scans; nothing else of it is used.
        ray: address of a Ray cluster that completes; see :func:`each_done`.
        device: device of each task there, as in :func:`lidargrit.inference.complete.open_model`.

    Returns:
        what was written, and how many points came in and went out.
    """
    completion = _Completion.of(source, out, model, task, output, config)
    folder = completion.folder
    jobs = completion.jobs(folder.missing)
    first = list(islice(jobs, 1))  # a mistake in it is told before anything is written
    written: list[Written] = []
    with folder.writing(task.progress) as progress:
        if ray and first:
            folder.tell_sensor(completion.sensor_of(first[0]))  # whichever file is written first
            named = json.dumps(model.sensor.to_json()) if model.folder is None else ""
            settings = model.sampling, model.projection, device
            work = _Work(source, out, model.name, named, *settings, task, output, config)
            size = model.batch_size
            shares = [folder.missing[first : first + size] for first in range(0, len(folder.missing), size)]
            for count, some, left_out in each_done(
                partial(_write_some, work), shares, ray=ray, on_gpus=device != "cpu"
            ):
                folder.leave_out(left_out)
                written += some
                progress.advance(count)
        else:
            for some in completion.write(chain(first, jobs)):
                written.append(some)
                progress.advance(some.scans)
    points = (sum(getattr(each, name) for each in written) for name in ("points_in", "points_out", "points_filled"))
    return Written(folder.num_written, *points)


def _write_cloud(
    path: Path, kind: str, task: Task, job: _Job, images: RangeImage
) -> tuple[bool, Int64[np.ndarray, "3"]]:
    """Write a completed cloud.

    Returns:
        whether its labels are kept; points that came in, that went out, and that were filled.
    """
    seen = InputScan.of_image(job.scan.image) if job.scan.points is None else job.scan
    done = task.result(seen, job.condition, images)
    kept_labels = write_cloud(path, kind, done, job.form)
    kept, added = int(done.kept.sum()), 0 if done.filled is None else len(done.filled)
    return kept_labels, np.array([len(done.scan), kept + added, added])


def _facts(model: Model, output: OutputConfig) -> dict[str, Any]:
    """Return the entries of the manifest that say how the files are made."""
    if output.count > 1 and not model.generator.is_random:
        got = f"--samples {output.count} for {model.name}"
        raise ConfigError(got, "1: it completes a scan in one way", "leave it out")
    made = {**model.identity(), "count": output.count, "seed": output.seed, "format": output.format}
    named = {"probability": output.probability, "projection": model.projection}
    return made | {name: of for name, of in named.items() if of not in (0, "sensor")}  # as folders without them are


def _files(inputs: Inputs, source: str, output: OutputConfig) -> list[str]:
    """Return the name of each file below the folder: all completions of the first scan, then of the next."""
    if len(inputs) * output.count > _FILES_AT_MOST:
        got = f"{output.count:,} completions of each of {len(inputs):,} scans"
        raise ConfigError(got, f"at most {_FILES_AT_MOST:,} files", "ask for fewer")
    names = [inputs.scans.name(index) for index in range(len(inputs))]
    if output.format == TREE:
        names = KittiTree(Path()).files(names)
    else:
        names = [name + suffix_of(inputs.suffix(index), output.format) for index, name in enumerate(names)]
    check_names(source, names)
    if taken := [name for name in names if name.endswith(PROBABILITY)]:
        got = f"a scan that would be {taken[0]}, as files of return probabilities are called"
        raise OutputError(got, "another name", "rename the scan, or choose another --format")
    return [_folder(turn, output.count) + name for name in names for turn in range(output.count)]


def _batches(jobs: Iterable[_Job], at_most: int) -> Iterator[list[_Job]]:
    """Group jobs that follow one another; scans of a batch have the same planes."""
    for _, alike in groupby(jobs, lambda job: job.condition.planes.keys()):
        while batch := list(islice(alike, at_most)):
            yield batch


def _completed(model: Model, jobs: Sequence[_Job], seed: int) -> list[RangeImage]:
    """Return what a model makes of each scan: a batch of the images that the scan consists of."""
    of_jobs = [(job.scan.rays, job.condition, job.scan.rays.seeds(seed + job.turn, job.number)) for job in jobs]
    condition = Observed.cat([rays.beside_one_another(known, seeds) for rays, known, seeds in of_jobs])
    images = complete_images(model, condition, [one for *_, seeds in of_jobs for one in seeds])
    ends = list(accumulate(job.scan.rays.phases for job in jobs))
    return [images[end - job.scan.rays.phases : end] for job, end in zip(jobs, ends, strict=True)]


def _return_share(model: Model, job: _Job, output: OutputConfig) -> Float[Tensor, "H W"]:
    """Return how often each pixel of the model's own image returns, over samples that are not written themselves."""
    total = torch.zeros(job.condition.return_mask.shape[1:])
    remaining = iter(range(output.probability))
    while turns := list(islice(remaining, model.batch_size)):
        condition = Observed.cat([job.condition[:1]] * len(turns))
        seeds = [scan_seed(output.seed, job.number, turn, 1) for turn in turns]
        total += complete_images(model, condition, seeds).return_mask.float().sum(0)
    return total / output.probability


def _probability_file(file: str) -> str:
    return f"{file.removesuffix(Path(file).suffix)}{PROBABILITY}"


def _folder(turn: int, count: int) -> str:
    return f"completion_{turn}/" if count > 1 else ""
