"""A recipe → the arithmetic that its training takes, and the recipe cut to a budget of it."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode
from torch.utils.module_tracker import ModuleTracker

from lidargrit.errors import ConfigError
from lidargrit.generators import load_class
from lidargrit.nn.objective import Objective
from lidargrit.nn.precision import Precision
from lidargrit.sensors import SensorModel
from lidargrit.structures import RangeImage
from lidargrit.training.config import FitConfig, Recipe
from lidargrit.training.engine import Engine

_SCANS = 2  # of a counted batch: some objectives compare the scans of a batch, so one alone would not do
_STEPS = 16  # counted of players who take turns: some of their terms come in every 16th step only
_A100_FP32_FLOPS_PER_S, _A100_BF16_FLOPS_PER_S = 19.5e12, 312e12
_SHARE = 0.25  # of a card's peak: a guess for networks as small as these; few scans at once reach less
_STRIP = 16  # columns: as often as the deepest of our networks halves them


def training_flops(recipe: Recipe) -> dict[str, int]:
    """Count the floating-point operations of a recipe's training, stage by stage, forward and backward.

    Products and convolutions are counted as they are called, two operations for a multiplication with its addition, on
    a few steps with scans that return everywhere at 10 m. Validation and optimiser are left out.
    """
    return _counted(recipe, recipe.data.load_sensor())


def estimated_training_flops(recipe: Recipe) -> dict[str, int]:
    """Return what :func:`training_flops` does, in seconds and little memory also where images are large.

    A layer's operations grow with the columns of the image, attention's with their square: so those of one, two and
    three narrow strips of it tell those of the whole, but for layers of R2DM that are made by the number of columns
    (3 % too much).
    """
    sensor = recipe.data.load_sensor()
    strips = sensor.width / _STRIP
    if strips <= 6 or sensor.width % _STRIP:
        return training_flops(recipe)
    try:
        narrow = [_counted(recipe, _strip(sensor, number * _STRIP)) for number in (1, 2, 3)]
    except ConfigError:  # a network that halves the columns more often
        return training_flops(recipe)
    # The parabola through three points at 1, 2 and 3 (Lagrange).
    weights = ((strips - 2) * (strips - 3) / 2, -(strips - 1) * (strips - 3), (strips - 1) * (strips - 2) / 2)
    return {
        stage: round(sum(weight * one[stage] for weight, one in zip(weights, narrow, strict=True)))
        for stage in narrow[0]
    }


def _counted(recipe: Recipe, sensor: SensorModel) -> dict[str, int]:
    with torch.random.fork_rng(range(torch.cuda.device_count())):
        torch.manual_seed(0)
        generator = load_class(recipe.generator)(recipe.model, sensor)
        found = {}
        for stage in generator.stages:
            found[stage] = round(_flops_per_scan(generator.objective(stage), sensor) * recipe.training[stage].scans)
        return found


def _strip(sensor: SensorModel, columns: int) -> SensorModel:
    elevation = sensor.elevation_rad
    kept = elevation if elevation.shape[1] == 1 else elevation[:, :columns]
    return replace(sensor, elevation_rad=kept, azimuth_rad=sensor.azimuth_rad[:, :columns])


def gpu_time(flops: int, precision: Precision) -> str:
    """Return the operations and an estimate of the time that a GPU of the paper's day takes for them, for a person.

    Source:
        Peaks of the card without sparsity: NVIDIA A100 datasheet, 2021.
    """
    kind, peak = ("fp32", _A100_FP32_FLOPS_PER_S) if precision == "fp32" else ("bf16", _A100_BF16_FLOPS_PER_S)
    return (
        f"{flops:.2e} floating-point operations, by estimate {duration(flops / (_SHARE * peak))} of one A100 "
        f"at {_SHARE:.0%} of its {peak / 1e12:g} TFLOP/s in {kind}"
    )


def duration(seconds: float) -> str:
    """Return a time in the unit that suits it, for a person."""
    for unit, length in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:.0f} s"


def with_budget(recipe: Recipe, flops: float) -> Recipe:
    """Return the recipe with more or fewer scans, all stages by one factor, so that its training takes ``flops``.

    What is counted in scans besides the budget (warm-up, validation) shrinks or grows alike; averages only shrink.

    Raises:
        ConfigError: a budget that is not even a batch of every stage.
    """
    if not recipe.training:
        return recipe
    share = flops / sum(training_flops(recipe).values())
    return replace(recipe, training={name: _scaled(stage, share) for name, stage in recipe.training.items()})


def _scaled(config: FitConfig, share: float) -> FitConfig:
    scans = round(config.scans * share / config.batch_size) * config.batch_size
    if scans < config.batch_size:
        raise ConfigError(
            f"a budget for {config.scans * share:.1f} scans in batches of {config.batch_size}",
            "at least one batch of every stage",
            "raise the budget",
        )
    return replace(
        config,
        scans=scans,
        warmup_scans=round(config.warmup_scans * share),
        average_over_scans=round(config.average_over_scans * min(share, 1)),
        validate_every=max(config.batch_size, round(config.validate_every * share)),
    )


def same_everywhere(sensor: SensorModel, count: int) -> RangeImage:
    """Return scans that return everywhere, at 10 m: enough where only the arithmetic matters."""
    range_m = torch.full((count, sensor.height, sensor.width), 10.0).clamp(sensor.range_min_m, sensor.range_max_m)
    return RangeImage(range_m, torch.ones_like(range_m, dtype=torch.bool), sensor, torch.full_like(range_m, 0.3))


def _flops_per_scan(objective: Objective, sensor: SensorModel) -> float:
    images = same_everywhere(sensor, _SCANS)
    engine = Engine("fp32", bool(objective.players))
    engine.set_up(objective, torch.optim.SGD(objective.parameters(), lr=0.0))  # the quickest: it is not counted
    steps = _STEPS if objective.players else 1
    counter = FlopCounterMode(display=False)
    # Which module an operation is of is not asked, and the tracker stumbles over penalties.
    counter.mod_tracker = _NoModules()
    # The fused attention of a CPU is no product to the counter.
    with counter, sdpa_kernel(SDPBackend.MATH):
        for step in range(steps):
            engine.step(images.to(engine.device), step, 0.0)
    return counter.get_total_flops() / (steps * _SCANS)


class _NoModules(ModuleTracker):
    """Keeps no track of modules: what is counted counts once, in all."""

    def __enter__(self) -> ModuleTracker:
        return self

    def __exit__(self, *_: object) -> None:
        pass
