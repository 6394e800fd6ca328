"""The training loop of every model: (objective, range images, configuration) → trained weights in a folder."""

import math
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Self

import torch
from torch import Tensor

from lidargrit.core import reporting
from lidargrit.core.determinism import derive_seed, evenly_spaced
from lidargrit.core.errors import ConfigError, Terminated, TrainingError
from lidargrit.core.files import remove_partials
from lidargrit.data.batches import Batches
from lidargrit.data.images import RangeImages
from lidargrit.data.pasts import Pasts
from lidargrit.data.run_folder import CHECKPOINT_FILE
from lidargrit.generation.conditions import ToldOfScans
from lidargrit.generation.conditions.nothing import NothingTold
from lidargrit.generation.objective import Objective
from lidargrit.generation.settings import TrainingConfig
from lidargrit.nn.blocks import prepare_for_training
from lidargrit.scans.example import Example
from lidargrit.training.checkpoint import load_checkpoint, save_checkpoint
from lidargrit.training.engine import Engine
from lidargrit.training.log import Log
from lidargrit.training.optimiser import WeightAverage, learning_rate_at, make_optimiser


class Termination:
    """Within its ``with`` block, a SIGTERM makes ``asked`` true and does not end the process.

    Batch schedulers send this signal some seconds before they kill. Python lets only the main thread handle signals;
    in other threads the block changes nothing.

    Args:
        deadline_s: value of ``time.monotonic()`` from which on ``asked`` is true without a signal.
    """

    def __init__(self, deadline_s: float = math.inf) -> None:
        self._signalled, self._deadline_s = False, deadline_s

    @property
    def asked(self) -> bool:
        """Whether training is to stop after the step in progress."""
        return self._signalled or time.monotonic() >= self._deadline_s

    def __enter__(self) -> "Termination":
        try:
            self._before = signal.signal(signal.SIGTERM, self._note)
        except ValueError:  # not the main thread
            self._before = None
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGTERM, self._before)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._signalled = True


_LOG_EVERY_STEPS = 20


@dataclass
class StageTraining:
    """One stage of a run in training.

    Args:
        folder: folder of ``checkpoint.safetensors`` and ``log.jsonl``.
        seed: seed of order, augmentation, dropout and the objective's random numbers.
        built_on: fingerprint of the earlier stage's weights; a checkpoint with another one is refused.
        condition: source of what the generator is told of each scan.
        plot: function that plots the averaged objective into a file; None for no pictures.
        deadline_s: value of ``time.monotonic()`` at which training stops as it does by SIGTERM.
    """

    objective: Objective
    config: TrainingConfig
    folder: Path
    seed: int
    built_on: str = ""
    workers: int = 1
    condition: ToldOfScans = field(default_factory=NothingTold)
    plot: Callable[[Objective, Path], None] | None = None
    deadline_s: float = math.inf

    def begun(self) -> Self:
        """Launch its processes, read its checkpoint and open its log, and return it ready to run.

        Raises:
            ConfigError: settings that the objective cannot follow.
            CheckpointError: a checkpoint of other weights.
            TrainingError: processes that found different checkpoints.
        """
        self.engine, self.optimiser = begin_training(self.objective, self.config)
        self.average = WeightAverage(self.objective, self.config.average_over_scans)
        self.scans_seen = 0
        if self.checkpoint.exists():
            self.scans_seen = load_checkpoint(
                self.checkpoint, self.objective, self.average, self.optimiser, self.built_on
            )
        if not self.engine.same(self.scans_seen):
            raise TrainingError(
                f"{self.checkpoint} after {self.scans_seen} scans here, and not so in another process",
                "one checkpoint for all processes",
                "share the run's folder between the machines, and start again",
            )
        self._lacks_validation = False
        self.engine.by_first(self._begin)
        return self

    @property
    def checkpoint(self) -> Path:
        """File from which the stage resumes."""
        return self.folder / CHECKPOINT_FILE

    def run(self, train: RangeImages, val: RangeImages, what: str) -> Objective:
        """Train until all scans of the budget are seen, and return the objective with its averaged weights.

        Raises:
            TrainingError: the loss is not finite; names the scans seen and the last good checkpoint.
            OutputError: a checkpoint could not be written; the one before it is intact.
            Terminated: SIGTERM was received, or the time is over; the step in progress was finished and saved.
        """
        config = self.config
        batches = Batches(
            train,
            config.batch_size,
            config.augmentations,
            config.any_columns,
            self.seed,
            self.engine.rank,
            self.engine.world_size,
            self.workers,
            self.condition.of,
            self.objective.keeps_encodings,
            self.condition.past_scans,
        )
        begun = time.monotonic()
        progress_bar = reporting.progress(what, config.scans, self.scans_seen)
        with Termination(self.deadline_s) as termination, progress_bar as progress:
            if self.engine.any(self._lacks_validation) and self._validates():  # the process ended before it
                self._log_terms("val", self.validate(val, termination), 0.0)
            note = ""
            for example in batches.stream(self.scans_seen, config.scans):
                terms = self._step(example)
                stops = self.engine.any(termination.asked)
                logs = self._passed(_LOG_EVERY_STEPS * config.batch_size)
                saves = self._passed(config.checkpoint_every) or self._validates() or stops
                if logs or saves or self.engine.sees_at_once:  # else the host would wait for a GPU in every step
                    self._check_finite(terms)
                    note = f"loss {float(terms['loss']):.4f}  {self.engine.peak_gib():.1f} GiB"
                progress.advance(config.batch_size, note)
                if logs:
                    found = {name: float(term) for name, term in terms.items()}
                    self._log_terms("train", found, time.monotonic() - begun)
                if saves:
                    self._save()  # before anything that may fail, or take longer than a terminated process has
                if stops:
                    raise Terminated
                if self._validates():
                    self._log_terms("val", self.validate(val, termination), time.monotonic() - begun)
                if config.pictures_every and self._passed(config.pictures_every):
                    self.engine.by_first(self._plot)
        self.engine.by_first(self._close_log)
        if self.engine.any(termination.asked):  # since the last step
            raise Terminated
        return self.average.objective.eval()

    def validate(self, images: RangeImages, termination: Termination | None = None) -> dict[str, float]:
        """Return the averaged objective's mean loss terms over evenly spaced validation scans.

        Raises:
            Terminated: SIGTERM was received meanwhile; the resumed training validates again.
        """
        chosen = evenly_spaced(self.config.validation_scans, len(images))
        pasts = Pasts(images, self.condition.past_scans) if self.condition.past_scans else None
        totals: dict[str, float] = {}
        # As many at once as a process has in a step, since more may not fit in memory.
        at_once = max(1, self.config.batch_size // (self.engine.world_size * self.config.accumulate))
        first = 0
        for indices in images.alike(chosen, at_once):
            if termination is not None and self.engine.any(termination.asked):
                raise Terminated
            batch = images.batch(indices)
            example = Example(batch, self.condition.of(batch) if pasts is None else pasts.of(indices))
            terms = self.engine.evaluate(self.average.objective, example, derive_seed(self.seed, 3, first))
            for name, value in terms.items():
                totals[name] = totals.get(name, 0.0) + value * len(indices) / len(chosen)
            first += len(indices)
        return totals

    def _step(self, example: Example) -> dict[str, Tensor]:
        config = self.config
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate_at(config, self.scans_seen)
        seed = derive_seed(self.seed, 2, self.scans_seen, self.engine.rank)
        torch.manual_seed(derive_seed(seed, 0, 1))  # of dropout, which takes the global random numbers
        terms = self.engine.step(example.to(self.engine.device), seed, config.gradient_clip, config.accumulate)
        if self.engine.sees_at_once:
            self._check_finite(terms)
        self.scans_seen += config.batch_size
        self.average.update(self.objective, self.scans_seen, config.batch_size)
        return terms

    def _check_finite(self, terms: dict[str, Tensor]) -> None:
        if self.engine.is_finite():
            return
        raise TrainingError(
            f"a loss or gradient of {float(terms['loss'].detach())} after {self.scans_seen} scans",
            "finite numbers",
            "use a new folder and a lower training.*.learning_rate"
            + (f"; the last checkpoint is {self.checkpoint}" if self.checkpoint.exists() else ""),
        )

    def _begin(self) -> None:
        remove_partials(self.checkpoint.parent)
        self.log = Log(self.folder, self.scans_seen)  # only the first process has one
        self._lacks_validation = self.scans_seen > 0 and not self.log.validated

    def _close_log(self) -> None:
        self.log.close()

    def _plot(self) -> None:
        if self.plot is not None:
            self.plot(self.average.objective, self.folder / "pictures" / f"{self.scans_seen:09d}.png")

    def _validates(self) -> bool:
        return self._passed(self.config.validate_every) or self.scans_seen >= self.config.scans

    def _passed(self, every: int) -> bool:
        return self.scans_seen // every > (self.scans_seen - self.config.batch_size) // every

    def _save(self) -> None:
        kept = (self.checkpoint, self.objective, self.average, self.optimiser, self.scans_seen, self.built_on)
        self.engine.by_first(lambda: save_checkpoint(*kept))

    def _log_terms(self, split: str, terms: dict[str, float], seconds: float) -> None:
        self.engine.by_first(lambda: self.log.write(split, self.scans_seen, seconds, terms))
        if split == "val":
            losses = "  ".join(f"{name} {value:.4g}" for name, value in terms.items())
            reporting.message(f"  after {self.scans_seen} scans, on val: {losses}")
            for warning in self.objective.warnings():
                reporting.message(f"  WARNING: {warning}")


def begin_training(objective: Objective, config: TrainingConfig) -> tuple[Engine, torch.optim.Optimizer]:
    """Return the engine that a stage is trained with, which holds the objective from now on, and the optimiser."""
    engine = Engine(config.precision, objective.reaches_all_weights and not objective.players)
    optimiser = follow_settings(objective, config, engine.world_size)
    engine.set_up(objective, optimiser)
    return engine, optimiser


def follow_settings(objective: Objective, config: TrainingConfig, processes: int) -> torch.optim.Optimizer:
    """Set an objective's networks as the settings of its training say, and return the optimiser."""
    _check_parts(objective, config, processes)
    if config.compile:
        _check_compiler()
    prepare_for_training(objective, config.recompute, config.compile)
    return make_optimiser(objective, config)


def _check_compiler() -> None:
    """Refuse to compile for a CPU without the compiler that torch would call, which fails at the first step only."""
    compiler = os.environ.get("CXX") or ("clang++" if sys.platform == "darwin" else "g++")
    if not torch.cuda.is_available() and shutil.which(compiler) is None:
        raise ConfigError(
            f"compile=true and no C++ compiler {compiler!r}", "one that torch can call", "install it, or leave it out"
        )


def _check_parts(objective: Objective, config: TrainingConfig, processes: int) -> None:
    """Refuse a number of parts into which a process cannot divide its share of a batch."""
    if config.accumulate > 1 and objective.players:
        raise ConfigError(
            f"accumulate={config.accumulate} for players who take turns",
            "1: they count their turns by the batches they see",
            "lower batch_size instead",
        )
    if config.batch_size % (processes * config.accumulate):
        raise ConfigError(
            f"batch_size={config.batch_size} on {processes} processes in {config.accumulate} parts each",
            f"a multiple of {processes * config.accumulate}, processes times parts",
            "change one of them",
        )
