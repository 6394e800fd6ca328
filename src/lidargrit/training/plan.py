"""A recipe → what it would do: every setting by its name, sizes, budgets and estimated cost."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from lidargrit import configuration
from lidargrit.generators import load_class
from lidargrit.nn.precision import Precision
from lidargrit.training.compute import estimated_training_flops, gpu_time
from lidargrit.training.config import Recipe
from lidargrit.training.optimiser import memory_of_weights


@dataclass(frozen=True)
class StagePlan:
    """What one stage would do.

    Args:
        name: of the stage.
        parameters: that it trains or looks through.
        scans: that it sees.
        batch_size: scans in a step, over all processes.
        memory: bytes of weights, their average and the optimiser, besides activations.
        flops: floating-point operations of all its steps, by estimate.
        precision: in which they are computed.
    """

    name: str
    parameters: int
    scans: int
    batch_size: int
    memory: int
    flops: int
    precision: Precision


@dataclass(frozen=True)
class TrainingPlan:
    """What a recipe would do.

    Args:
        title: of the recipe.
        published: the score that its source reports, or "".
        settings: every one by its name.
        rows: of an image.
        columns: of an image.
        range_m: nearest and farthest return.
        stages: in their order.
    """

    title: str
    published: str
    settings: dict[str, Any]
    rows: int
    columns: int
    range_m: tuple[float, float]
    stages: tuple[StagePlan, ...]

    def as_text(self) -> str:
        """Return all of it as lines for a person."""
        lines = [self.title, f"published: {self.published or 'no figure'}", ""]
        lines += [f"  {name} = {value}" for name, value in self.settings.items()]
        near_m, far_m = self.range_m
        lines += ["", f"range images of {self.rows}x{self.columns}, {near_m:g} to {far_m:g} m"]
        lines += [
            f"{stage.name}: {stage.parameters:,} parameters, {stage.scans:,} scans in batches of {stage.batch_size}, "
            f"{stage.memory / 2**20:,.0f} MiB of memory besides activations"
            for stage in self.stages
        ]
        lines += [f"{stage.name}: {gpu_time(stage.flops, stage.precision)}" for stage in self.stages]
        return "\n".join(lines)

    def to_json(self) -> dict[str, Any]:
        """Return all of it as plain values."""
        return asdict(self)


def plan_training(recipe: Recipe) -> TrainingPlan:
    """Return what a recipe would do; nothing is read or written."""
    sensor = recipe.data.load_sensor()
    generator = load_class(recipe.generator)(recipe.model, sensor)
    stages, flops = [], estimated_training_flops(recipe)
    for name in generator.stages:
        objective, budget = generator.objective(name), recipe.training[name]
        parameters = sum(weight.numel() for weight in objective.parameters())
        size = (parameters, budget.scans, budget.batch_size, memory_of_weights(objective))
        stages.append(StagePlan(name, *size, flops[name], budget.precision))
    return TrainingPlan(
        recipe.title,
        recipe.published,
        configuration.leaves(recipe),
        sensor.height,
        sensor.width,
        (sensor.range_min_m, sensor.range_max_m),
        tuple(stages),
    )
