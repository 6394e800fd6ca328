"""A toy: scans around a mean range, told whether a fifth of the returns of a scan are of the road."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from lidargrit.core.errors import ConfigError
from lidargrit.generation.conditions import ToldOfScans
from lidargrit.generation.facts import Cost, SamplingSettings, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective
from lidargrit.nn.random import rngs_of
from lidargrit.scans.condition import Condition, Nothing
from lidargrit.scans.example import Example
from lidargrit.scans.types import RangeImage

ROAD = 40


@dataclass(frozen=True, eq=False)
class OfClass(Condition):
    """Which of two classes each scan has."""

    number: Tensor


class MoreRoad(ToldOfScans):
    """Whether a fifth of the returns are of the road."""

    kind = OfClass

    def of(self, images: RangeImage) -> OfClass:
        if images.label is None:
            raise ConfigError("scans without labels", "labels of the road", "name others")
        share = (images.label == ROAD).float().mean((1, 2)) / images.return_mask.float().mean((1, 2))
        return OfClass((share > 0.2).long())


@dataclass(frozen=True)
class ToyConfig:
    """Settings.

    Args:
        start: mean of ln(1 + range) before training.
    """

    start: float = 2.0


class Toy(Generator[ToyConfig, SamplingSettings]):
    """A mean for each class, and one for scans of which nothing is known."""

    Config = ToyConfig
    facts = SystemFacts(generates="range around a mean of its class")

    def __init__(self, config, sensor):
        super().__init__(config, sensor)
        self.means = nn.Parameter(torch.full((3,), config.start))

    @classmethod
    def smallest_config(cls, sensor):
        return ToyConfig()

    @property
    def takes(self) -> frozenset[type[Condition]]:
        return frozenset({Nothing, OfClass})

    @property
    def stages(self):
        return ("means",)

    def objective(self, stage):
        return ToyObjective(self)

    def load_stage(self, stage, objective):
        self.load_state_dict(objective.toy.state_dict())

    def _sample(self, seeds, condition, sampling):
        numbers = condition.number if isinstance(condition, OfClass) else torch.full((len(seeds),), 2)
        size = (self.sensor.height, self.sensor.width)
        noise = torch.stack([torch.rand(size, generator=rng) for rng in rngs_of(seeds)])
        range_m = self.means[numbers].expm1()[:, None, None] + noise
        return RangeImage(range_m, torch.ones_like(range_m, dtype=torch.bool), self.sensor)

    def cost(self, sampling=None):
        return Cost(1, self.sensor.height * self.sensor.width)


class ToyObjective(Objective):
    """The squared error of the class's mean."""

    reaches_all_weights = False

    def __init__(self, toy):
        super().__init__(toy.sensor)
        self.toy = toy

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        assert isinstance(example.condition, OfClass)
        found = example.images.range_m.clamp(min=1).log1p().mean((1, 2))
        told, untold = self.toy.means[example.condition.number], self.toy.means[2]
        return {"loss": (found - told).square().mean() + (found - untold).square().mean()}
