"""A network that completes scans: observed pixels → range images, by triangulation and a U-Net."""

from dataclasses import dataclass, field

import torch

from lidargrit.core.configuration import Settings
from lidargrit.generation.batches import BatchSeeds
from lidargrit.generation.facts import Cost, NoSampling, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective
from lidargrit.nn.flops import FlopCounter
from lidargrit.nn.random import rngs_of
from lidargrit.scans.condition import Condition, Observed
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.systems.completion.network import CompletionNetwork, CompletionNetworkConfig
from lidargrit.systems.completion.objective import CompletionObjective


@dataclass(frozen=True)
class CompletionConfig(Settings):
    """The network, which is the whole system.

    Args:
        completion: sizes of the network that completes scans.
    """

    completion: CompletionNetworkConfig = field(default_factory=CompletionNetworkConfig)


class Completion(Generator[CompletionConfig, NoSampling]):
    """A network between observed pixels: its range is a best guess, its mask is sampled.

    A scan of which nothing is observed is completed, too, but it never learned that: such scans all have the same
    ranges, so that it is no model of scans.
    """

    Config = CompletionConfig
    trains = (("completion", "completion"),)
    facts = SystemFacts(
        generates="range as a best guess and raydrop around observed pixels; no scans worth sampling",
        first_command="complete SCANS completed --observed rows:4 --model RUN",
    )
    capabilities = frozenset({"complete"})

    def __init__(self, config: CompletionConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        self.completion = CompletionNetwork(config.completion, sensor)

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> CompletionConfig:
        """Return networks of eight channels and one block."""
        sizes = CompletionNetworkConfig((8, 8, 8), blocks=1, attention_layers=1, heads=2, features=4, mask_width=4)
        return CompletionConfig(sizes)

    def objective(self, stage: str) -> Objective:
        """Return the errors of hidden pixels."""
        return CompletionObjective(self.completion, self.sensor)

    @property
    def takes(self) -> frozenset[type[Condition]]:
        """Observations alone: it has no new scans to sample."""
        return frozenset({Observed})

    def _complete(self, condition: Observed, seeds: BatchSeeds, sampling: NoSampling) -> RangeImage:
        return self.completion.sample(condition, rngs_of(seeds))

    def cost(self, sampling: NoSampling | None = None) -> Cost:
        """Return the cost of two estimates of the range and all phases of the mask, counted while it is computed."""
        nothing = Observed.nothing(self.sensor, 1).to(self.device)
        with torch.no_grad(), FlopCounter() as counter:
            self.completion.sample(nothing, [torch.Generator()])
        return Cost(2 + len(self.completion.mask.phases), counter.total)
