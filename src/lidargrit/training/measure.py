"""A preset → the time and memory of its training on this machine, predicted from a few timed steps of each stage."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch

from lidargrit.generation import conditions
from lidargrit.generation.settings import Preset
from lidargrit.scans.example import Example
from lidargrit.training.compute import duration, training_flops, uniform_images
from lidargrit.training.stage import begin_training

_WARM_UP_STEPS, _TIMED_STEPS = 1, 3  # the first one allocates and chooses kernels


@dataclass(frozen=True)
class Measured:
    """What the training of one stage takes on this machine.

    Args:
        flops: floating-point operations of all steps.
        seconds: predicted time of all steps.
        peak_gib: largest memory that this process has held so far, in GiB.
    """

    stage: str
    flops: int
    scans_per_s: float
    seconds: float
    device: str
    peak_gib: float

    def as_text(self) -> str:
        """Return all of it for a person."""
        return (
            f"{self.stage}: {self.flops:.2e} floating-point operations at {self.scans_per_s:.3g} scans/s: "
            f"{duration(self.seconds)} on {self.device}, {self.peak_gib:.1f} GiB"
        )


def measure(preset: Preset, flops: Mapping[str, int] | None = None) -> list[Measured]:
    """Take a few steps of every stage that is trained; predict the time of all, without reading and validation.

    Args:
        flops: operations of each stage that is trained, as a plan has counted them; counted here if not given.
    """
    flops = training_flops(preset) if flops is None else flops
    found = []
    for stage, of_stage in flops.items():  # those that are trained
        timed = _timed(preset, stage)
        seconds = preset.settings_of(stage).scans / timed.scans_per_s
        seconds *= of_stage / (of_stage - timed.prepared_flops)  # preparing is as fast
        found.append(Measured(stage, of_stage, timed.scans_per_s, seconds, timed.device, timed.peak_gib))
    return found


def scans_per_s(preset: Preset, stage: str) -> float:
    """Return on how many scans a second this machine trains a stage, without reading and validation."""
    return _timed(preset, stage).scans_per_s


class _Timed(NamedTuple):
    scans_per_s: float
    prepared_flops: int
    device: str
    peak_gib: float


def _timed(preset: Preset, stage: str) -> _Timed:
    with torch.random.fork_rng(range(torch.cuda.device_count())):
        torch.manual_seed(0)
        generator = preset.build_generator()
        condition = conditions.load(preset.data.condition, generator.past_scans)
        config, objective = preset.settings_of(stage), generator.objective(stage)
        engine, _ = begin_training(objective, config)
        images = uniform_images(preset.data.load_sensor(), config.batch_size // engine.world_size).to(engine.device)
        prepared, begun = objective.preparation_flops(config.scans), 0.0
        for step in range(_WARM_UP_STEPS + _TIMED_STEPS):
            begun = time.perf_counter() if step == _WARM_UP_STEPS else begun
            # Other images every time, as in training: none whose encoding is known already. What is prepared once for
            # many steps, by the seed of a step, is prepared in the first.
            new = replace(images, range_m=images.range_m * (1 - 1e-4 * step))
            seed = 0 if prepared else step
            example = Example(new, condition.of(new))
            float(engine.step(example, seed, config.gradient_clip, config.accumulate)["loss"])  # waits for a GPU
        per_s = _TIMED_STEPS * config.batch_size / (time.perf_counter() - begun)
        return _Timed(per_s, prepared, str(engine.device), engine.peak_gib())
