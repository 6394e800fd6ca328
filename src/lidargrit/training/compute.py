"""A preset → the floating-point operations of its training, and the preset scaled to a budget of them."""

import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import product
from typing import Any

import torch

from lidargrit.core.configuration import COUNTS_SCANS
from lidargrit.core.errors import ConfigError
from lidargrit.generation import conditions
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective
from lidargrit.generation.settings import Preset, TrainingConfig
from lidargrit.nn.flops import FlopCounter
from lidargrit.nn.precision import Precision
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage

_SCANS = 2  # in a counted batch: some objectives compare the scans of a batch
_STEPS_AT_MOST = 64  # that are counted; rarer terms hardly cost
_A100_FLOPS_PER_S = {"fp32": 19.5e12, "tf32": 156e12, "bf16": 312e12}
_CORRECTIONS, _OVERSPENT_AT_MOST = 20, 0.02  # of a budget
_GPU_FROM_FLOPS = 1e16  # less is a training of small batches, which wait for the launches of kernels
_SHARE = 0.25  # of a peak: a guess for networks as small as these; small batches reach less
_MATRIX, _REPETITIONS = 512, 8  # the first repetition chooses a kernel


@dataclass(frozen=True)
class StageCost:
    """Operations of a stage's training.

    Args:
        flops_per_scan: floating-point operations of a step for each scan that it sees.
        preparation_flops: number of scans that a training sees → operations of what is prepared once for it.
    """

    flops_per_scan: float
    preparation_flops: Callable[[int], int]

    def flops(self, scans: int) -> int:
        """Return the operations of a training of so many scans."""
        return round(self.flops_per_scan * scans) + self.preparation_flops(scans)


def training_flops(preset: Preset) -> dict[str, int]:
    """Count the floating-point operations of a preset's training, forward and backward, for each stage.

    Matrix products and convolutions are counted while a few steps run, on scans whose every pixel returns at 10 m. A
    multiplication with its addition counts as two operations. Validation and the optimiser are not counted. An image
    that a trained network encodes for a later stage is counted at every sight, since how many images there are is not
    known from a preset, although its encoding is kept and computed once.

    The steps run on tensors that have a shape and no values, so that nothing is computed, and networks of any width are
    counted alike. Only where the operations of an objective depend on values, as those of a network that completes
    scans do, are the steps computed.

    Returns:
        number of operations, by the name of the stage; none for frozen stages of another run.
    """
    return {name: cost.flops(preset.settings_of(name).scans) for name, cost in stage_costs(preset).items()}


def stage_costs(preset: Preset) -> dict[str, StageCost]:
    """Count the operations of every stage that is trained by its name, whatever number of scans it is trained on."""
    with torch.random.fork_rng(range(torch.cuda.device_count())):
        torch.manual_seed(0)
        sensor = preset.data.load_sensor()
        with torch.device("meta"):
            generator = preset.build_generator(sensor).to("meta")
        costs = {}
        for stage in (name for name in generator.stages if name not in preset.frozen):
            try:
                costs[stage] = _cost_without_values(preset, generator, stage, sensor)
            except (RuntimeError, NotImplementedError):  # torch's for a value that was asked for, and for two devices
                costs[stage] = _cost_with_values(preset, preset.build_generator(sensor), stage, sensor)
    return costs


def computing_time(flops: int, precision: Precision) -> str:
    """Return a line for a person: operations, and estimated times on this machine's CPU and, for many, on a GPU.

    Source:
        Peaks of an NVIDIA A100 without sparsity: its datasheet, 2021.
    """
    kind = "bf16" if precision == "auto" else precision
    here = _cpu_flops_per_s()
    text = (
        f"{flops:.2e} floating-point operations, by estimate {duration(flops / (_SHARE * here))} on this machine's CPU "
        f"at {_SHARE:.0%} of its {here / 1e9:.0f} GFLOP/s in matrix products"
    )
    if flops < _GPU_FROM_FLOPS:
        return text
    peak = _A100_FLOPS_PER_S[kind]
    there = duration(flops / (_SHARE * peak))
    return f"{text}, {there} on one A100 at {_SHARE:.0%} of its {peak / 1e12:g} TFLOP/s in {kind}"


@cache
def _cpu_flops_per_s() -> float:
    """Measure how fast this machine multiplies matrices, with the threads that torch uses now; takes some ms."""
    matrix, seconds = torch.ones(_MATRIX, _MATRIX), []
    for _ in range(_REPETITIONS):
        begun = time.perf_counter()
        _ = matrix @ matrix
        seconds.append(time.perf_counter() - begun)
    return 2 * _MATRIX**3 / min(seconds)


def duration(seconds: float) -> str:
    """Return a time as text, in days, hours, minutes or seconds."""
    for unit, length in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:,.1f} {unit}"
    return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:.0f} s"


def with_budget(preset: Preset, flops: float) -> Preset:
    """Return the preset with more or fewer scans, by one factor for all stages, so that its training takes ``flops``.

    Stages that are taken from another run stay as they are: they are not trained.

    Warm-up and the distance between validations are scaled by the same factor; the half-life of averages and settings
    of the model that count scans only fall.

    Args:
        flops: number of floating-point operations that the training may take.
    """
    costs, share, scaled = stage_costs(preset), 1.0, preset
    if not costs:
        return preset
    spent, best, best_spent = _flops_of(costs, scaled), None, 0
    for _ in range(_CORRECTIONS):
        # What is prepared once, such as a reflow's pairs, does not grow or shrink in proportion.
        share *= flops / spent
        for name in costs:
            config, scans = preset.settings_of(name), preset.settings_of(name).scans * share
            if not round(scans / config.batch_size):
                raise ConfigError(
                    f"a budget of {flops:.2g} operations, {scans:.1f} scans for {preset.generator}'s stage {name!r}",
                    f"at least one batch of {config.batch_size} scans in every stage",
                    f"raise it to {1.1 * flops * config.batch_size / scans:.2g}",
                )
        trained = {name: _scaled(preset.settings_of(name), share) for name in costs}
        scaled = replace(preset, training={**preset.training, **trained}, model=_with_fewer_scans(preset.model, share))
        spent = _flops_of(costs, scaled)
        if best_spent < spent <= flops * (1 + _OVERSPENT_AT_MOST):  # whole batches may come no nearer
            best, best_spent = scaled, spent
        if abs(spent / flops - 1) <= _OVERSPENT_AT_MOST:
            break
    return best or scaled


def _flops_of(costs: Mapping[str, StageCost], preset: Preset) -> int:
    return sum(cost.flops(preset.settings_of(name).scans) for name, cost in costs.items())


def _scaled(config: TrainingConfig, share: float) -> TrainingConfig:
    scans = round(config.scans * share / config.batch_size) * config.batch_size
    return replace(
        config,
        scans=scans,
        warmup_scans=round(config.warmup_scans * share),
        average_over_scans=round(config.average_over_scans * min(share, 1)),
        validate_every=max(config.batch_size, round(config.validate_every * share)),
    )


def _with_fewer_scans(model: Any, share: float) -> Any:
    """Return a generator's configuration with the settings that count training scans lowered to a share."""
    counted = [each.name for each in fields(model) if COUNTS_SCANS in each.metadata]
    return replace(model, **{name: round(getattr(model, name) * min(share, 1)) for name in counted})


def uniform_images(sensor: SensorModel, count: int) -> RangeImage:
    """Return range images whose every pixel returns at 10 m, for counting operations and measuring speed.

    Their reflectance is also a mark of surfaces that return; see lidargrit.scans.marks.
    """
    range_m = torch.full((count, sensor.height, sensor.width), 10.0).clamp(sensor.range_min_m, sensor.range_max_m)
    mask, label = torch.ones_like(range_m, dtype=torch.bool), torch.full(range_m.shape, 40)
    return RangeImage(range_m, mask, sensor, {"reflectance": torch.full_like(range_m, 0.65), "label": label})


def _uniform_examples(preset: Preset, generator: Generator, sensor: SensorModel) -> Example:
    images = uniform_images(sensor, _SCANS)
    return Example(images, conditions.load(preset.data.condition, generator.past_scans).of(images))


class _SeedOfNoValues(torch.Generator):
    """Random numbers for objectives that make them on the device of their source."""

    device = torch.device("meta")


def _cost_without_values(preset: Preset, generator: Generator, stage: str, sensor: SensorModel) -> StageCost:
    """Count the operations of a stage's training, of a generator whose weights have no values."""
    with torch.device("meta"):
        objective = generator.objective(stage)
    objective.to("meta")
    for module in objective.modules():
        for name, buffer in module.named_buffers(recurse=False):
            if buffer.ndim == 0 and not buffer.is_floating_point():  # a counter, by which steps differ
                module.register_buffer(name, torch.zeros_like(buffer, device="cpu"))
    return _cost(objective, _uniform_examples(preset, generator, sensor).to("meta"), _SeedOfNoValues)


def _cost_with_values(preset: Preset, generator: Generator, stage: str, sensor: SensorModel) -> StageCost:
    return _cost(generator.objective(stage), _uniform_examples(preset, generator, sensor), torch.Generator)


def _cost(objective: Objective, example: Example, make_rng: Callable[[], torch.Generator]) -> StageCost:
    steps = min(objective.period, _STEPS_AT_MOST)
    objective.train()
    with FlopCounter() as counter, warnings.catch_warnings():
        # Torch asks an image of which a penalty takes the gradient for one that was not kept, and warns itself of it.
        warnings.filterwarnings("ignore", "The .grad attribute of a Tensor")
        for step, player in product(range(steps), objective.players or ("",)):
            objective(example, make_rng().manual_seed(step), player)["loss"].backward()
    return StageCost(counter.total / (steps * len(example)), objective.preparation_flops)
