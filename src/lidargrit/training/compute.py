"""A recipe → the floating-point operations of its training, and the recipe scaled to a budget of them."""

from __future__ import annotations

import warnings
from dataclasses import replace
from itertools import chain, product

import torch
from torch import Tensor
from torch.func import functional_call
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode
from torch.utils.module_tracker import ModuleTracker

from lidargrit.errors import ConfigError
from lidargrit.nn.objective import Objective
from lidargrit.nn.precision import Precision
from lidargrit.sensors import SensorModel
from lidargrit.structures import RangeImage
from lidargrit.training.config import FitConfig, Recipe

_SCANS = 2  # in a counted batch: some objectives compare the scans of a batch
_STEPS_AT_MOST = 64  # that are counted; rarer terms hardly cost
_A100_FP32_FLOPS_PER_S, _A100_BF16_FLOPS_PER_S = 19.5e12, 312e12
_SHARE = 0.25  # of a card's peak: a guess for networks as small as these; small batches reach less


def training_flops(recipe: Recipe) -> dict[str, int]:
    """Count the floating-point operations of a recipe's training, forward and backward, for each stage.

    Matrix products and convolutions are counted while a few steps run, on scans whose every pixel returns at 10 m. A
    multiplication with its addition counts as two operations. Validation and the optimiser are not counted.

    The steps run on weights that have a shape and no values, so that nothing is computed. Only where the operations of
    an objective depend on values, as MaskGIT's do, are the steps computed.

    Returns:
        number of operations, by the name of the stage.
    """
    with torch.random.fork_rng(range(torch.cuda.device_count())):
        torch.manual_seed(0)
        sensor = recipe.data.load_sensor()
        generator = recipe.build_generator(sensor)
        return {
            stage: round(_flops_per_scan(generator.objective(stage), sensor) * recipe.training[stage].scans)
            for stage in generator.stages
        }


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
        f"{flops:.2e} floating-point operations, by estimate {duration(flops / (_SHARE * peak))} on one A100 "
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
    from torch._subclasses import fake_tensor  # noqa: PLC0415  takes two seconds, and only counting needs it

    images, steps = uniform_images(sensor, _SCANS), min(objective.period, _STEPS_AT_MOST)
    objective.train()
    mode = fake_tensor.FakeTensorMode(allow_non_fake_inputs=True)
    own = chain(objective.named_parameters(), objective.named_buffers())
    # Counters, by which steps differ, keep their values.
    without_values: dict[str, Tensor] = {
        name: mode.from_tensor(tensor) for name, tensor in own if tensor.is_floating_point()
    }
    try:
        total = _total_flops(objective, without_values, images, steps)
    except (
        fake_tensor.DataDependentOutputException,
        fake_tensor.DynamicOutputShapeException,
        fake_tensor.UnsupportedOperatorException,
    ):
        total = _total_flops(objective, {}, images, steps)
    return total / (steps * _SCANS)


def _total_flops(objective: Objective, tensors: dict[str, Tensor], images: RangeImage, steps: int) -> int:
    """Count the operations of some steps of all players, with other tensors in place of the objective's own."""
    counter = FlopCounterMode(display=False)
    # The counter's tracker of modules fails on gradient penalties, and counts by module are not needed.
    counter.mod_tracker = _NoModules()
    # The counter does not see the matrix products within the fused attention of a CPU.
    with counter, sdpa_kernel(SDPBackend.MATH), warnings.catch_warnings():
        # Torch asks an image of which a penalty takes the gradient for one that was not kept, and warns itself of it.
        warnings.filterwarnings("ignore", "The .grad attribute of a Tensor")
        for step, player in product(range(steps), objective.players or ("",)):
            rng = torch.Generator().manual_seed(step)
            functional_call(objective, tensors, (images, rng, player))["loss"].backward()
    return counter.get_total_flops()


class _NoModules(ModuleTracker):
    """Tracks no modules, so that every operation is counted once, in the total."""

    def __enter__(self) -> ModuleTracker:
        return self

    def __exit__(self, *_: object) -> None:
        pass
