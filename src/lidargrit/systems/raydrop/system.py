"""A network of raydrop: clean scans, in which every surface returns → the returns that a sensor would get of them."""

from dataclasses import dataclass, field

import torch

from lidargrit.core.configuration import Settings
from lidargrit.core.errors import ConfigError
from lidargrit.generation.batches import BatchSeeds
from lidargrit.generation.facts import Cost, NoSampling, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective
from lidargrit.nn.flops import FlopCounter
from lidargrit.nn.random import rngs_of
from lidargrit.scans.condition import Condition, ConditionKind, Observed
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.systems.raydrop.network import RaydropNetwork, RaydropNetworkConfig
from lidargrit.systems.raydrop.objective import RaydropObjective


@dataclass(frozen=True)
class RaydropConfig(Settings):
    """The network, which is the whole system.

    Args:
        raydrop: sizes of the network of raydrop, and what it learns from.
    """

    raydrop: RaydropNetworkConfig = field(default_factory=RaydropNetworkConfig)


class Raydrop(Generator[RaydropConfig, NoSampling]):
    """A network over the ranges of all surfaces, which samples whether each of them returns; ranges stay as they are.

    Rays that are known not to return have no surface. There are no other scans that it could generate.
    """

    Config = RaydropConfig
    trains = (("raydrop", "raydrop"),)
    facts = SystemFacts(
        generates="raydrop of clean scans; reflectance of what returns if model.raydrop.reflectance is set",
        first_command="raydrop SCANS dropped --model RUN",
    )
    capabilities = frozenset({"complete"})

    def __init__(self, config: RaydropConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        self.raydrop = RaydropNetwork(config.raydrop, sensor)

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> RaydropConfig:
        """Return networks of eight channels and one block, which learn from scans of any kind."""
        sizes = RaydropNetworkConfig("estimated", (8, 8, 8), blocks=1, features=4, mask_width=4)
        return RaydropConfig(sizes)

    @property
    def conditions(self) -> frozenset[ConditionKind]:
        """Ranges of surfaces, and pixels among them whose returns are known."""
        return frozenset({"surfaces"})

    def objective(self, stage: str) -> Objective:
        """Return the likelihood of which surfaces return."""
        return RaydropObjective(self.raydrop, self.sensor)

    @property
    def takes(self) -> frozenset[type[Condition]]:
        """Observations alone: it has no new scans to sample."""
        return frozenset({Observed})

    def _complete(self, condition: Observed, seeds: BatchSeeds, sampling: NoSampling) -> RangeImage:
        if not bool((condition.range_observed | condition.return_observed).all()):
            raise ConfigError(
                "scans with rays of which nothing is known",
                "the range of each surface, and which rays meet none",
                "take clean scans of the whole circle, or a model that completes scans",
            )
        return self.raydrop.sample(condition, rngs_of(seeds))

    def cost(self, sampling: NoSampling | None = None) -> Cost:
        """Return the cost of the features and of all phases of the mask, counted while they are computed."""
        range_m = torch.full((1, self.sensor.height, self.sensor.width), self.sensor.range_max_m)
        clean = RangeImage(range_m, range_m > 0, self.sensor).to(self.device)
        with torch.no_grad(), FlopCounter() as counter:
            self.raydrop.sample(Observed.of_surfaces(clean), [torch.Generator()])
        return Cost(1 + len(self.raydrop.mask.phases), counter.total)
