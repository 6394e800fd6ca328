"""A recipe → the floating-point operations of its training, and the recipe scaled to a budget of them."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode
from torch.utils.module_tracker import ModuleTracker

from lidargrit.errors import ConfigError
from lidargrit.nn.objective import Objective
from lidargrit.nn.precision import Precision
from lidargrit.sensors import SensorModel
from lidargrit.structures import RangeImage
from lidargrit.training.config import FitConfig, Recipe
from lidargrit.training.engine import Engine

_SCANS = 2  # in a counted batch: some objectives compare the scans of a batch
_STEPS = 16  # counted of adversarial objectives, some of whose terms come only every 16th step
_A100_FP32_FLOPS_PER_S, _A100_BF16_FLOPS_PER_S = 19.5e12, 312e12
_SHARE = 0.25  # of a card's peak: a guess for networks as small as these; small batches reach less
_STRIP = 16  # columns: the deepest of our networks halves their number four times


def training_flops(recipe: Recipe) -> dict[str, int]:
    """Count the floating-point operations of a recipe's training, forward and backward, for each stage.

    Matrix products and convolutions are counted while a few steps run, on scans whose every pixel returns at 10 m. A
    multiplication with its addition counts as two operations. Validation and the optimiser are not counted.

    Returns:
        number of operations, by the name of the stage.
    """
    return _counted(recipe, recipe.data.load_sensor())


def estimated_training_flops(recipe: Recipe) -> dict[str, int]:
    """Estimate what :func:`training_flops` counts, in seconds and little memory also where images are large.

    The operations of a convolution grow with the number of columns, those of attention with its square. So counts on
    images of 16, 32 and 48 columns determine the count on the whole image. The estimate is 3 % too high for R2DM, some
    of whose layers depend on the number of columns in another way.
    """
    # Torch's fake tensors, which take no memory, stop at the codebook, whose counts depend on values.
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
        generator = recipe.build_generator(sensor)
        found = {}
        for stage in generator.stages:
            found[stage] = round(_flops_per_scan(generator.objective(stage), sensor) * recipe.training[stage].scans)
        return found


def _strip(sensor: SensorModel, columns: int) -> SensorModel:
    elevation = sensor.elevation_rad
    kept = elevation if elevation.shape[1] == 1 else elevation[:, :columns]
    return replace(sensor, elevation_rad=kept, azimuth_rad=sensor.azimuth_rad[:, :columns])


def gpu_time(flops: int, precision: Precision) -> str:
    """Return a line for a person: the operations, and the estimated time of an NVIDIA A100 for them.

    Args:
        flops: number of floating-point operations.
        precision: precision of the operations.

    Source:
        Peaks of the card without sparsity: NVIDIA A100 datasheet, 2021.
    """
    kind, peak = ("fp32", _A100_FP32_FLOPS_PER_S) if precision == "fp32" else ("bf16", _A100_BF16_FLOPS_PER_S)
    return (
        f"{flops:.2e} floating-point operations, by estimate {duration(flops / (_SHARE * peak))} of one A100 "
        f"at {_SHARE:.0%} of its {peak / 1e12:g} TFLOP/s in {kind}"
    )


def duration(seconds: float) -> str:
    """Return a time as text, in days, hours, minutes or seconds."""
    for unit, length in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:.0f} s"


def with_budget(recipe: Recipe, flops: float) -> Recipe:
    """Return the recipe with more or fewer scans, by one factor for all stages, so that its training takes ``flops``.

    Warm-up and the distance between validations are scaled by the same factor; the half-life of averages only falls.

    Args:
        recipe: recipe to scale.
        flops: number of floating-point operations that the training may take.

    Raises:
        ConfigError: the budget is smaller than one batch of every stage.
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


def uniform_images(sensor: SensorModel, count: int) -> RangeImage:
    """Return range images whose every pixel returns at 10 m, for counting operations and measuring speed."""
    range_m = torch.full((count, sensor.height, sensor.width), 10.0).clamp(sensor.range_min_m, sensor.range_max_m)
    return RangeImage(range_m, torch.ones_like(range_m, dtype=torch.bool), sensor, torch.full_like(range_m, 0.3))


def _flops_per_scan(objective: Objective, sensor: SensorModel) -> float:
    images = uniform_images(sensor, _SCANS)
    engine = Engine("fp32", bool(objective.players))
    engine.set_up(objective, torch.optim.SGD(objective.parameters(), lr=0.0))  # the cheapest; it is not counted
    steps = _STEPS if objective.players else 1
    counter = FlopCounterMode(display=False)
    # The counter's tracker of modules fails on gradient penalties, and counts by module are not needed.
    counter.mod_tracker = _NoModules()
    # The counter does not see the matrix products within the fused attention of a CPU.
    with counter, sdpa_kernel(SDPBackend.MATH):
        for step in range(steps):
            engine.step(images.to(engine.device), step, 0.0)
    return counter.get_total_flops() / (steps * _SCANS)


class _NoModules(ModuleTracker):
    """Tracks no modules, so that every operation is counted once, in the total."""

    def __enter__(self) -> ModuleTracker:
        return self

    def __exit__(self, *_: object) -> None:
        pass
