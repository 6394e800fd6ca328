"""Classical methods without weights: observed pixels → range images, by the nearest return, on lines or triangles."""

from dataclasses import dataclass
from typing import Literal

from lidargrit.core.configuration import Settings
from lidargrit.generation.batches import BatchSeeds
from lidargrit.generation.facts import Cost, SamplingSettings, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.scans.condition import Observed
from lidargrit.scans.fills import fill
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage


@dataclass(frozen=True)
class InterpolationConfig(Settings):
    """The method.

    Args:
        method: source of a range. ``nearest``: the nearest observed return by angle; ``linear``: those above and below;
            ``triangulation``: the triangle of three.
    """

    method: Literal["nearest", "linear", "triangulation"] = "triangulation"


class Interpolation(Generator[InterpolationConfig, SamplingSettings]):
    """A classical method, for any sensor: it learns nothing, and completes a scan in one way whatever the seed."""

    Config = InterpolationConfig
    facts = SystemFacts(
        generates="range between observed returns, raydrop of the nearest observed pixel",
        first_command="complete SCANS completed --observed rows:4 --model RUN",
    )
    capabilities = frozenset({"complete"})
    has_new_scans = False
    is_random = False

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> InterpolationConfig:
        """Return the settings themselves."""
        return InterpolationConfig()

    def _complete(self, condition: Observed, seeds: BatchSeeds, sampling: SamplingSettings) -> RangeImage:
        return fill(self.config.method, condition[: seeds.num_asked_for]).to(self.device)  # one by one

    def cost(self, sampling: SamplingSettings | None = None) -> Cost:
        """Return no operations: there is no network."""
        return Cost(0, 0)
