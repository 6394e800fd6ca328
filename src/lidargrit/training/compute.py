"""A recipe → the arithmetic that its training takes, and the recipe cut to a budget of it."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode
from torch.utils.module_tracker import ModuleTracker

from lidargrit.errors import ConfigError
from lidargrit.generators import load_class
from lidargrit.sensors import SensorModel
from lidargrit.structures import RangeImage
from lidargrit.training.engine import Engine
from lidargrit.training.optimiser import make_optimiser
from lidargrit.training.settings import FitConfig, Recipe

_SCANS = 2  # of a counted batch: some objectives compare the scans of a batch, so one alone would not do
_STEPS = 16  # counted of players who take turns: some of their terms come in every 16th step only


def training_flops(recipe: Recipe) -> dict[str, int]:
    """Count the floating-point operations of a recipe's training, stage by stage, forward and backward.

    Products and convolutions are counted as they are called, two operations for a multiplication with its addition, on
    a few steps with scans that return everywhere at 10 m. Validation and optimiser are left out.
    """
    with torch.random.fork_rng(range(torch.cuda.device_count())):
        torch.manual_seed(0)
        generator = load_class(recipe.generator)(recipe.model, recipe.data.load_sensor())
        found = {}
        for stage in generator.stages:
            config = recipe.training[stage]
            found[stage] = round(_flops_per_scan(generator.objective(stage), config, recipe) * config.scans)
        return found


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


def _flops_per_scan(objective: torch.nn.Module, config: FitConfig, recipe: Recipe) -> float:
    images = same_everywhere(recipe.data.load_sensor(), _SCANS)
    engine = Engine("fp32", hasattr(objective, "phases"))
    engine.set_up(objective, make_optimiser(objective, config))
    steps = _STEPS if hasattr(objective, "phases") else 1
    counter = FlopCounterMode(display=False)
    counter.mod_tracker = (
        _NoModules()
    )  # which module an operation is of is not asked; the tracker stumbles over penalties
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
