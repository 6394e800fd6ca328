"""Presets, finished runs and samples → each trained, sampled and scored alike → one table; goes on where it stopped."""

import json
import math
import time
from collections.abc import Sequence
from concurrent.futures import as_completed
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import torch

from lidargrit.core import reporting
from lidargrit.core.configuration import name_and_settings
from lidargrit.core.errors import ConfigError, LidarGritError
from lidargrit.core.files import claim_folder, read_json, write_json
from lidargrit.core.processes import process_pool
from lidargrit.core.table import Format, render
from lidargrit.core.version import __version__
from lidargrit.data.run_folder import is_run, locate, weights_sha256
from lidargrit.data.sources import Source, data_set_of, open_source
from lidargrit.data.sources.samples import read_samples
from lidargrit.evaluation.costs import COSTS, Costs, costs_table, read_costs
from lidargrit.evaluation.evaluate import EvalConfig, evaluate_pair, metric_factory, open_pair
from lidargrit.evaluation.metrics import load_metric
from lidargrit.evaluation.pairs import EvalPair, require_same_rays
from lidargrit.evaluation.protocols import MetricChoice, load_protocol, public_name
from lidargrit.evaluation.scorecard import NOT_APPLICABLE, Scorecard
from lidargrit.evaluation.tables import share_pixel_statistics, side_by_side
from lidargrit.evaluation.verdict import MEMORISED, PIXEL_STATISTICS
from lidargrit.generation.facts import SamplingSettings
from lidargrit.generation.generator import Generator, load, load_class
from lidargrit.generation.presets import is_preset, load_preset
from lidargrit.generation.settings import Preset
from lidargrit.inference.samples import write_samples
from lidargrit.nn.devices import usable_device
from lidargrit.scans.sensors import SensorModel
from lidargrit.training import check_folder, train, with_budget
from lidargrit.training.compute import duration
from lidargrit.training.plan import check_stages

PAGE = "table.html"
"""The page of the table, beside the folders of the systems."""
_SCORES = ".json"  # what evaluate --json wrote
_NAME_BYTES = 200  # of a folder's name, of 255: the name of its file of scores is longer
_SAMPLES_AT_MOST = 10**8  # names of files have eight digits


@dataclass(frozen=True)
class CompareConfig:
    """Settings that all systems of a comparison share.

    Args:
        reference: source of real scans on which none of the systems was trained.
        preset_settings: settings that are given to every preset, as by ``train --set``, so that all systems get the
            same data.
        flops: operations of the training of each system; 0 keeps every preset's own budget.
    """

    reference: str
    num_samples: int = 256
    settings: EvalConfig = field(default_factory=EvalConfig)
    preset_settings: tuple[str, ...] = ()
    flops: float = 0.0

    def __post_init__(self) -> None:
        if not 2 <= self.num_samples <= _SAMPLES_AT_MOST or not 0 <= self.flops < math.inf:
            raise ConfigError(
                f"{str(self.num_samples)[:25]} samples, {self.flops:g} operations",
                f"2 to {_SAMPLES_AT_MOST:,} samples, and a budget from 0 on",
                "correct the number",
            )

    def evaluation(self) -> EvalConfig:
        """Return the settings of the evaluation, of as many scans as samples."""
        return replace(self.settings, max_scans=self.num_samples)

    def preset(self, name: str, check: bool = True) -> Preset:
        """Return a preset with the settings and the budget that all systems get.

        Args:
            check: whether it is still to be trained, so that its stages have to follow the settings.
        """
        preset = load_preset(name, self.preset_settings)
        if check:
            check_stages(preset)
        return with_budget(preset, self.flops) if self.flops else preset


def run(systems: Sequence[str], folder: Path, comparison: CompareConfig, processes: int = 1) -> list[Path]:
    """Train or load each system, sample from it and score the samples, and return the files of scores.

    Args:
        systems: names of presets or folders of finished runs, each with sampling choices after a colon if wanted:
            ``r2dm_small:steps=32``; or folders of samples, of ours or of another program; or files of scores, which
            are taken as they are. A preset that occurs with several sampling choices is trained once.
        folder: output folder. It gets a run folder ``runs/PRESET``, and for each system ``SYSTEM/samples``, scores in
            ``SYSTEM/SYSTEM.json`` and ``SYSTEM/costs.json``. Existing results are kept.
        comparison: settings that all systems share.
        processes: number of systems that are made at the same time, each in a process with its share of the cores.
    """
    names = [_folder_name(system) for system in systems]
    if not names:
        raise ConfigError("no system", "at least one preset, run, folder of samples or file of scores", "name some")
    if twice := [system for system, name in zip(systems, names, strict=True) if names.count(name) > 1]:
        got = f"{' and '.join(twice)}, of which several would be called {_folder_name(twice[0])!r} in the table"
        raise ConfigError(got, "each once, by a name of its own", "name each once, or rename a file or folder")
    # Wrong words and runs of other presets are refused before anything is trained.
    plans = [_SystemJob.of(system, folder, comparison) for system in systems]
    reference = open_source(comparison.reference, comparison.settings.data.bad_points)
    if (comparison.preset_settings or comparison.flops) and not any(plan.preset for plan in plans):
        raise ConfigError("settings or a budget, and no preset", "a preset that they are for", "leave them out")
    by_run: dict[Path, list[_SystemJob]] = {}  # systems of one run one after the other: it is trained once
    for plan in plans:
        by_run.setdefault(plan.run, []).append(plan)
    _require_a_metric(comparison.evaluation())
    _warn_of_bounds(plans, reference)
    processes = min(processes, len(by_run))  # more would only take cores from one another
    remaining = _Remaining(list(systems))
    with claim_folder(folder):
        _check_reference(reference, plans, comparison)
        if processes == 1:
            for plan in chain.from_iterable(by_run.values()):
                sampled = _finish([plan], folder, comparison, reference)
                remaining.without([plan.system], sampled)
        else:
            with process_pool(processes, partial(_share, processes)) as pool:
                heard_from = reporting.current().of_process
                begun = {
                    pool.submit(_finish_as_process, heard_from(run.name), some, folder, comparison): some
                    for run, some in by_run.items()
                }
                for done in as_completed(begun):
                    remaining.without([plan.system for plan in begun[done]], done.result())
        paths = [folder / name / f"{name}.json" for name in names]
        share_pixel_statistics(paths)
    return paths


def _require_a_metric(settings: EvalConfig) -> None:
    """Refuse metrics none of which can be made, as for want of weights, with the reason of the first."""
    errors = []
    for choice in settings.chosen_metrics():
        try:
            metric_factory(choice, settings)()
        except LidarGritError as error:
            errors.append(error)
        else:
            return
    raise errors[0]


def _check_reference(reference: Source, plans: "Sequence[_SystemJob]", comparison: CompareConfig) -> None:
    """Project the reference for every sensor, and refuse one of other rays, before anything is trained."""
    config = comparison.evaluation().data_config()
    sensors = [plan.sensor for plan in plans if plan.sensor is not None]
    for sensor in {json.dumps(sensor.to_json()): sensor for sensor in sensors}.values():
        images = reference.images(sensor, config)
        require_same_rays(sensor, images.sensor)
        images.batch([0])  # the size of a file is known once it is read


def _warn_of_bounds(plans: "Sequence[_SystemJob]", reference: Source) -> None:
    """Warn of rows that bound the scores of another data set than the reference's: theirs has to be trained on."""
    unclear = {"", "folder", data_set_of(reference.text)[0] or reference.data_set}  # a folder's may be any data set
    presets = {plan.system: plan.preset for plan in plans if plan.preset is not None}
    others = {
        name: source
        for name, preset in presets.items()
        for source in preset.data.train
        if preset.generator in (PIXEL_STATISTICS, MEMORISED) and data_set_of(source)[0] not in unclear
    }
    if others:
        reporting.message(
            f"WARNING: {' and '.join(others)} would learn from {' and '.join(sorted({*others.values()}))}, another "
            f"data set than that of {reference.text}, and bound no score against it; name scans of that data set with "
            "--set data.train=FOLDER data.val=FOLDER"
        )


def _finish_as_process(
    reporter: reporting.Reporter, plans: "Sequence[_SystemJob]", folder: Path, comparison: CompareConfig
) -> int:
    with reporting.to(reporter):
        return _finish(plans, folder, comparison)


def _finish(
    plans: "Sequence[_SystemJob]", folder: Path, comparison: CompareConfig, reference: Source | None = None
) -> int:
    """Train or load the systems of one run, sample from each, score the samples, and return how many were sampled."""
    sampled = 0
    reference = reference or open_source(comparison.reference, comparison.settings.data.bad_points)
    for plan in plans:
        name = _folder_name(plan.system)
        here, scores = folder / name, folder / name / f"{name}{_SCORES}"
        reporting.message(f"{name}:")
        if plan.card is not None:
            write_json(scores, plan.card.to_json())
            Costs(here / COSTS, plan.card.samples.weights_sha256).write_unknown()
        elif plan.samples is not None:
            _score_samples(plan.samples, reference, comparison, scores)
            Costs(here / COSTS, plan.samples.weights_sha256).write_unknown()
        else:
            generator = load(plan.run) if plan.preset is None or is_run(plan.run) else train(plan.preset, plan.run)
            generator.to(usable_device(""))
            timed = _sample(generator, plan.run, here / "samples", plan.sampling, comparison)
            sampled += timed is not None
            costs = Costs(here / COSTS, weights_sha256(plan.run))
            costs.write(generator, plan.sampling, plan.preset, timed)
            pair = _score_samples(open_source(str(here / "samples")), reference, comparison, scores)
            costs.add_bits(generator, pair.reference)
    return sampled


def _score_samples(samples: Source, reference: Source, comparison: CompareConfig, path: Path) -> EvalPair:
    """Write the scores of samples into a file, unless it holds them, and return the two sets."""
    settings = comparison.evaluation()
    pair = open_pair(samples, reference, settings)
    if samples.folder is not None:
        pair = _of_first_seeds(pair, samples.folder)
    _score(pair, settings, path)
    _warn_of_limits(pair, comparison)
    return pair


def _warn_of_limits(pair: EvalPair, comparison: CompareConfig) -> None:
    """Warn where fewer scans are compared than were asked for: systems of other numbers get another table."""
    compared, protocol = len(pair.samples), comparison.settings.protocol
    if compared == comparison.num_samples:
        return
    if compared == load_protocol(protocol).scans_at_most(comparison.num_samples):
        limit = f"protocol {protocol} takes"
    else:
        few = pair.samples if len(pair.samples.images) == compared else pair.reference
        limit = f"{few.source} has"
    reporting.message(f"WARNING: {limit} {compared:,} scans, so as many are compared; -n {compared} compares all alike")


def _of_first_seeds(pair: EvalPair, folder: Path) -> EvalPair:
    """Return a pair in which as many samples are those of the first seeds, from 0 on.

    The folder may hold more, of an earlier comparison of more samples: spaced evenly over these, the samples of this
    system would have other seeds than those of a system that is sampled now.
    """
    samples = replace(pair.samples, images=read_samples(folder), indices=range(len(pair.samples)))
    return replace(pair, samples=samples)


def _folder_name(system: str) -> str:
    """Return the name of a system's folder in the table; "." and ".." stand for the folders that they name."""
    run, colon, settings = system.partition(":")
    own = str(Path(run)) if run.strip("./") else Path(run).resolve().name  # "runs/mine/" is "runs/mine"
    name = Path(system).stem if system.endswith(_SCORES) else f"{own}{colon}{settings}".replace("/", "_")
    name = name.encode()[-_NAME_BYTES:].decode(errors="ignore")  # the end of a path tells most
    taken = name == PAGE or f"{name}{_SCORES}" == COSTS  # or its folder would be the page, or its scores its costs
    return f"{name}_" if taken else name


def _share(processes: int) -> None:
    torch.set_num_threads(max(1, torch.get_num_threads() // processes))


class _Remaining:
    """Estimates how long the remaining systems take, each as long as the mean of those that were sampled just now."""

    def __init__(self, systems: list[str]) -> None:
        self._left, self._count = systems, len(systems)
        self._begun, self._sampled = time.monotonic(), 0

    def without(self, done: Sequence[str], sampled: int) -> None:
        """Report the remaining systems after some more are done, of which some were sampled and not there before."""
        self._sampled += sampled
        self._left = [system for system in self._left if system not in done]
        if self._left:
            time_left = ""
            if self._sampled:
                each_s = (time.monotonic() - self._begun) / self._sampled
                time_left = f", for about {duration(each_s * len(self._left))}"
            reporting.message(
                f"{self._count - len(self._left)} of {self._count} systems are done; left{time_left}: "
                f"{', '.join(self._left)}"
            )


def as_table(scores: Sequence[Path], form: Format = "text", remarks: Sequence[str] = ()) -> str:
    """Return the scores side by side, below them what each system costs, if that is known of one, and remarks."""
    costs = costs_table([(path.stem, path.parent / COSTS) for path in scores], remarks)
    known = remarks or any(any(numbers) for _, *numbers in costs.rows)
    return render([*side_by_side(scores), *([costs] if known else [])], form)


def as_json(scores: Sequence[Path]) -> list[dict[str, Any]]:
    """Return the name, the costs and the scores of each system, as the files hold them."""
    return [
        {"system": path.stem, "costs": read_costs(path.parent / COSTS), "scores": read_json(path)} for path in scores
    ]


@dataclass(frozen=True)
class _SystemJob:
    """How one system is made: from a finished run, or by training a preset; or its samples, which are there.

    Args:
        run: folder of a finished run, or of the one that the preset gets, or of samples; or a file of scores.
        preset: preset that is trained; None for a finished run.
        sensor: sensor of the scans; None for scores alone.
    """

    system: str
    run: Path
    preset: Preset | None
    sampling: SamplingSettings | None
    sensor: SensorModel | None
    samples: Source | None = None
    card: Scorecard | None = None

    @classmethod
    def of(cls, system: str, folder: Path, comparison: CompareConfig) -> "_SystemJob":
        if system.endswith(_SCORES):
            path, taken = Path(system), folder / _folder_name(system) / f"{_folder_name(system)}{_SCORES}"
            there = taken if taken.is_file() and not path.is_file() else path
            return cls(system, path, None, None, None, card=Scorecard.read(there))
        name, settings = name_and_settings(system)
        run, trained = locate(name), folder / "runs" / name
        if is_run(run):
            generator = load(run)
            _require_new_scans(generator, system)
            return cls(system, run, None, generator.parse_sampling(settings), generator.sensor)
        held = open_source(name) if run.is_dir() and not is_preset(name) else None
        if held is not None and held.is_generated:
            if settings:
                got = f"{system}, settings of sampling for samples that are there"
                raise ConfigError(got, "a folder of samples alone", "leave the settings out")
            return cls(system, run, None, None, held.sensor, held)
        preset = comparison.preset(name, check=not is_run(trained))
        generator = load_class(preset.generator)
        _require_new_scans(generator, system)
        sampling = generator.parse_sampling(settings)
        check_folder(trained, preset)
        return cls(system, trained, preset, sampling, preset.data.load_sensor())


def _require_new_scans(generator: Generator | type[Generator], system: str) -> None:
    if not generator.has_new_scans:
        got, cure = f"{system}, which samples no new scans", f"use it with: lidargrit {generator.facts.first_command}"
        raise ConfigError(got, "systems that do", cure)


def _sample(
    generator: Generator, run: Path, folder: Path, sampling: SamplingSettings | None, comparison: CompareConfig
) -> tuple[int, float] | None:
    """Sample what is not there yet, and return how many scans and the seconds for each; None if all was there."""
    before = len(list(folder.glob("[!.]*.npz"))) if folder.is_dir() else 0
    begun = time.perf_counter()
    write_samples(generator, run, folder, range(comparison.num_samples), sampling)
    sampled = comparison.num_samples - before
    return (sampled, (time.perf_counter() - begun) / sampled) if sampled > 0 else None


def _score(pair: EvalPair, settings: EvalConfig, path: Path) -> None:
    """Score two sets and write the file, unless it holds the scores of the same images by the same settings.

    Scores that rest on weights of a network are computed again if these were not there, or were others.
    """
    facts = (settings.facts(), pair.samples.record(), pair.reference.record(), __version__)
    wanted = (public_name(settings.protocol), *facts)
    if path.is_file():
        there = Scorecard.read(path)
        known = (there.protocol, there.settings, there.samples, there.reference, there.versions.get("lidargrit"))
        if known == wanted and not _has_other_weights(there, pair, settings):
            reporting.message(f"scores are there already; remove {path} to score again")
            return
    write_json(path, evaluate_pair(pair, settings).to_json())


def _has_other_weights(there: Scorecard, pair: EvalPair, settings: EvalConfig) -> bool:
    """Return whether the networks of metrics have weights now that they had not when these scores were computed."""
    stored = {MetricChoice(each.metric, each.variant): "" for each in there.left_out if each.verdict != NOT_APPLICABLE}
    results = [score.result for score in there.scores]
    stored |= {MetricChoice(each.metric, each.variant): each.weights_sha256 for each in results}
    for choice, sha256 in stored.items():
        if not load_metric(choice.metric).needs_weights:  # what the same program left out of the same images stays so
            continue
        with suppress(LidarGritError):  # still no weights, or images that this network cannot see
            metric = metric_factory(choice, settings)()
            for images, real in ((pair.samples, False), (pair.reference, True)):
                metric.update(images.batch([0]), real=real)  # some know only now which weights these images need
            if metric.weights_sha256 != sha256:
                return True
    return False
