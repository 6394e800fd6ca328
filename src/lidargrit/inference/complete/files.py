"""Scans of a user → their completions in files, which have the names of the scans."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, groupby, islice
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lidargrit.core.determinism import derive_seed, scan_seed
from lidargrit.core.errors import ConfigError, DataError, OutputError, ScanError
from lidargrit.core.files import claim_folder
from lidargrit.core.reporting import Reporter
from lidargrit.data import formats
from lidargrit.data.export import (
    IMAGE,
    TREE,
    KittiTree,
    check_names,
    claimed_scans,
    labels_lost,
    writable_format,
    write_array,
    write_with_labels,
)
from lidargrit.data.formats import ScanFormat
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources.image_files import PROBABILITY
from lidargrit.inference.complete import Model
from lidargrit.inference.complete.inputs import Inputs, InputScan
from lidargrit.scans.condition import Observed
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage

_FILES_AT_MOST = 400_000  # as many as the largest data set has scans; the manifest names each
_UNWRITABLE = ".npz"  # for range images, and for scans whose own format cannot be written, or is of another sensor


@dataclass(frozen=True)
class OutputConfig:
    """Number and kind of the files that completions are written to.

    Args:
        count: number of completions of each scan.
        seed: seed of the first completion of a scan; each further completion has the next seed.
        format: name or ending of a format, ``image`` for range images (H, W) in metres as ``.npy``, or
            ``kitti_odometry`` for its tree, with SemanticKITTI's files of labels. If empty, each file has the format of
            its scan where that can be written and takes the model's sensor, and ``.npz`` elsewhere.
        probability: number of samples of the mask from which ``NAME.probability.npy`` gives each pixel's share of
            returns; 0 for no such files.
    """

    count: int = 1
    seed: int = 0
    format: str = ""
    probability: int = 0

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ConfigError(f"-n {self.count}", "at least 1 completion of each scan", "raise it")
        if self.probability < 0:
            raise ConfigError(f"--probability {self.probability}", "0 or more samples", "raise it")


@dataclass(frozen=True, eq=False)
class _Job:
    index: int
    number: int
    turn: int
    scan: InputScan
    condition: Observed
    form: type[ScanFormat] | None


def write_completions(
    inputs: Inputs,
    out: Path,
    model: Model,
    condition_of: Callable[[InputScan, int], Observed],
    output: OutputConfig,
    facts: dict[str, Any],
    config: DataConfig,
    reporter: Reporter,
) -> int:
    """Complete every scan and write it; files that are there already are not written again.

    With one completion of each scan the files lie in ``out``, with several in ``out/completion_0`` and so on, each
    a whole set of scans. ``completed.json`` says how they were made.

    Args:
        inputs: scans of the user.
        out: an empty folder, or one that the same command began.
        condition_of: function that returns the condition for a scan and a seed.
        output: number and kind of files.
        facts: further entries of ``completed.json``, among them the ``source``; a folder with other entries is refused.
        config: treatment of scans that cannot be used; nothing else of it is used.

    Returns:
        Number of completed scans that are there now.

    Raises:
        ConfigError: several completions by what completes a scan in one way.
        OutputError: the folder holds something else, lies in the source, or cannot be written.
        ScanError, DataError: a scan that cannot be used, no usable one, or two that would be one file.
    """
    inputs.check_output(out)
    files, facts = _files(inputs, str(facts["source"]), output, model.sensor), facts | _facts(model, output)
    identities = {file: inputs.identity(index) for (index, _), file in files.items()}
    left_out, told_labels = set[int](), False
    missing = [job for job, file in files.items() if not (out / file).exists()]
    skipped = left_out if config.bad_scans == "skip" else None
    jobs = _jobs(inputs, missing, condition_of, output.seed, skipped, reporter)
    first = list(islice(jobs, 1))  # a mistake in it is told before anything is written
    with (
        claim_folder(out),
        claimed_scans(out / "completed.json", {**facts, "scans": identities}) as files_left_out,
        reporter.progress("completing", len(files), len(files) - len(missing)) as progress,
    ):
        for batch in _batches(chain(first, jobs), model.generator.compute_batch):
            for job, image in zip(batch, _completed(model, batch, output.seed), strict=True):
                file = files[job.index, job.turn]
                if output.probability and job.turn == 0:
                    share = _return_share(model, job, output)
                    write_array(out / f"{file.removesuffix(Path(file).suffix)}{PROBABILITY}", share)
                if not _write(out / file, output.format, image, job) and not told_labels:
                    told_labels = True
                    reporter.message(labels_lost(file))
                progress.advance(1)
        files_left_out.update(file for (index, _), file in files.items() if index in left_out)
    if len(left_out) == len(inputs):
        raise DataError("no usable scan", "at least one", "see the messages above")
    return len(files) - len(left_out) * output.count


def _facts(model: Model, output: OutputConfig) -> dict[str, Any]:
    """Return the entries of the manifest that say how the files are made."""
    if output.count > 1 and not model.generator.is_random:
        got = f"-n {output.count} for {model.name}"
        raise ConfigError(got, "1: it completes a scan in one way", "leave it out")
    made = {**model.identity(), "count": output.count, "seed": output.seed, "format": output.format}
    if output.probability:
        made["probability"] = output.probability  # files of before it were written without these shares
    return made


def _files(inputs: Inputs, source: str, output: OutputConfig, sensor: SensorModel) -> dict[tuple[int, int], str]:
    """Return the name of each file below the folder, by the index of its scan and the number of the completion."""
    if len(inputs) * output.count > _FILES_AT_MOST:
        got = f"{output.count:,} completions of each of {len(inputs):,} scans"
        raise ConfigError(got, f"at most {_FILES_AT_MOST:,} files", "ask for fewer")
    names = [inputs.name(index) for index in range(len(inputs))]
    if output.format == TREE:
        names = KittiTree(Path()).files(names)
    else:
        names = [name + _suffix(inputs.suffix(index), output.format, sensor) for index, name in enumerate(names)]
    check_names(source, names)
    if taken := [name for name in names if name.endswith(PROBABILITY)]:
        got = f"a scan that would be {taken[0]}, as files of return probabilities are called"
        raise OutputError(got, "another name", "rename the scan, or choose another --format")
    return {
        (index, turn): _folder(turn, output.count) + name
        for index, name in enumerate(names)
        for turn in range(output.count)
    }


def _jobs(
    inputs: Inputs,
    missing: Sequence[tuple[int, int]],
    condition_of: Callable[[InputScan, int], Observed],
    seed: int,
    skipped: set[int] | None,
    reporter: Reporter,
) -> Iterator[_Job]:
    """Read each scan of missing files once; note those that cannot be used in a set, or refuse them without one."""
    last, scan, condition = -1, None, None
    for index, turn in missing:
        if index != last:
            last, scan = index, None
            try:
                scan = inputs.read(index)
                condition = condition_of(scan, derive_seed(seed, inputs.number(index)))
            except ScanError as error:
                if skipped is None:
                    raise
                reporter.message(f"left out: {error}")
                skipped.add(index)
                scan = None
        if scan is not None and condition is not None:
            yield _Job(index, inputs.number(index), turn, scan, condition, inputs.form(index))


def _batches(jobs: Iterable[_Job], at_most: int) -> Iterator[list[_Job]]:
    """Group jobs that follow one another; a batch has reflectance, or labels, only if all of its scans have them."""
    for _, alike in groupby(jobs, lambda job: (job.condition.reflectance is None, job.condition.label is None)):
        while batch := list(islice(alike, at_most)):
            yield batch


def _completed(model: Model, jobs: Sequence[_Job], seed: int) -> list[RangeImage]:
    condition = Observed.cat([job.condition for job in jobs])
    images = model.complete(condition, [_seed(seed, job) for job in jobs])
    return [images[index] for index in range(len(jobs))]


def _return_share(model: Model, job: _Job, output: OutputConfig) -> Float[Tensor, "H W"]:
    """Return how often each pixel returns, over samples that are not written themselves."""
    total = torch.zeros(job.condition.return_mask.shape[1:])
    remaining = iter(range(output.probability))
    while turns := list(islice(remaining, model.generator.compute_batch)):
        condition = Observed.cat([job.condition] * len(turns))
        seeds = [scan_seed(output.seed, job.number, turn, 1) for turn in turns]
        total += model.complete(condition, seeds).return_mask.float().sum(0)
    return total / output.probability


def _seed(seed: int, job: _Job) -> int:
    return scan_seed(seed + job.turn, job.number)


def _folder(turn: int, count: int) -> str:
    return f"completion_{turn}/" if count > 1 else ""


def _suffix(of_input: str, kind: str, sensor: SensorModel) -> str:
    if kind == IMAGE:
        return ".npy"
    if kind:
        return writable_format(kind, IMAGE, TREE)[1]
    known = formats.candidates(Path(f"scan{of_input}")) if of_input else ()
    fits = any(one.can_write() and of_input in one.suffixes and one.sensor in {"", sensor.name} for one in known)
    return of_input if fits else _UNWRITABLE


def _write(path: Path, kind: str, image: RangeImage, job: _Job) -> bool:
    """Write a completed scan, and return whether the file keeps its labels, if it has any."""
    if kind == IMAGE:
        write_array(path, image.range_m)
        return image.label is None
    scan = job.scan.joined(image, job.condition)
    if kind == TREE:
        write_with_labels(path, scan)
        return True
    named = [one for one in formats.candidates(path) if one.can_write()]
    form = writable_format(kind)[0] if kind else named[0]
    if not kind and job.form in named and (scan.reflectance is None or "reflectance" in job.form.keeps):
        form = job.form
    form.write(path, scan)
    return scan.label is None or "label" in form.keeps
