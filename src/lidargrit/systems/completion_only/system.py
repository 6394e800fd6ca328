"""A network that completes scans and nothing else: observed pixels → range images, by triangulation and a U-Net."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from lidargrit.generation.batches import BatchSeeds
from lidargrit.generation.facts import Cost, NoSampling, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective
from lidargrit.nn.flops import FlopCounter
from lidargrit.nn.random import rngs_of
from lidargrit.scans.condition import Condition
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.systems.completion_only.completion_network import CompletionNetwork, CompletionNetworkConfig
from lidargrit.systems.completion_only.completion_objective import CompletionObjective


@dataclass(frozen=True)
class CompletionOnlyConfig:
    """The network, which is the whole system.

    Args:
        completion: sizes of the network that completes scans.
    """

    completion: CompletionNetworkConfig = field(default_factory=CompletionNetworkConfig)


class CompletionOnly(Generator[CompletionOnlyConfig, NoSampling]):
    """The completion network of LidarGRIT by itself, for a sensor or a size for which there is no whole model.

    Its range is a best guess and its mask is sampled. A scan of which nothing is observed is completed, too, but it
    never learned that: such scans all have the same ranges, so that it is no model of scans.
    """

    Config = CompletionOnlyConfig
    facts = SystemFacts(
        generates="range as a best guess and raydrop around observed pixels; no scans worth sampling",
        first_command="complete SCANS completed --observed rows:4 --model RUN",
    )
    capabilities = frozenset({"complete"})

    def __init__(self, config: CompletionOnlyConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        self.completion = CompletionNetwork(config.completion, sensor)

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> CompletionOnlyConfig:
        """Return networks of eight channels and one block."""
        sizes = CompletionNetworkConfig((8, 8, 8), blocks=1, attention_layers=1, heads=2, features=4, mask_width=4)
        return CompletionOnlyConfig(sizes)

    @property
    def stages(self) -> tuple[str, ...]:
        """The network alone."""
        return ("completion",)

    def objective(self, stage: str) -> Objective:
        """Return the errors of hidden pixels."""
        return CompletionObjective(self.completion, self.sensor)

    def load_stage(self, stage: str, objective: Objective) -> None:
        """Take over the trained weights."""
        self.completion.load_state_dict(objective.get_submodule(stage).state_dict())

    def _sample(self, seeds: BatchSeeds, sampling: NoSampling) -> RangeImage:
        return self._complete(Condition.nothing(self.sensor, len(seeds)).to(self.device), seeds, sampling)

    def _complete(self, condition: Condition, seeds: BatchSeeds, sampling: NoSampling) -> RangeImage:
        rngs = rngs_of(seeds)
        return self.completion.sample(condition, rngs)

    def cost(self, sampling: NoSampling | None = None) -> Cost:
        """Return the cost of two estimates of the range and all phases of the mask, counted while it is computed."""
        nothing = Condition.nothing(self.sensor, 1).to(self.device)
        with torch.no_grad(), FlopCounter() as counter:
            self.completion.sample(nothing, [torch.Generator()])
        return Cost(2 + len(self.completion.mask.phases), counter.total)
