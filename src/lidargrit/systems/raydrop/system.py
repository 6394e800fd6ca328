"""A network of raydrop: clean scans, in which every surface returns → the returns that a sensor would get of them."""

import math
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from lidargrit.core.configuration import Settings
from lidargrit.core.errors import ConfigError
from lidargrit.generation.any_sensor import RayObjective
from lidargrit.generation.batches import BatchSeeds
from lidargrit.generation.facts import Cost, SamplingSettings, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective, hidden_in_some
from lidargrit.generation.reflectance import reflectance_error, required_reflectance
from lidargrit.generation.semantic_classes import labels_to_learn
from lidargrit.nn.flops import FlopCounter
from lidargrit.nn.random import rngs_of
from lidargrit.scans import marks
from lidargrit.scans.condition import ConditionKind, Observed
from lidargrit.scans.example import Example
from lidargrit.scans.fills import ranges_from_others
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.systems.raydrop.network import RaydropNetwork, RaydropNetworkConfig

_NOISE_M = 0.03  # largest standard deviation of noise added in training: clean ranges may come with noise or not
_ALONE_WEIGHT, _REFLECTANCE_WEIGHT = 0.5, 2.0
_SETTING = "model.raydrop.reflectance"
_WITHOUT_LABELS = 0.25  # of the scans, so that a network with classes drops returns of scans without labels, too


class RaydropObjective(RayObjective):
    """The likelihood of which surfaces return, in phases and pixel by pixel."""

    additions = frozenset({"labels", "reflectance", "any_sensor"})
    reaches_all_weights = False  # some phases stand for all

    def __init__(self, network: RaydropNetwork, sensor: SensorModel) -> None:
        super().__init__(sensor)
        self.raydrop = network
        self.needs_marks = network.config.surfaces == "known"

    def check(self, images: RangeImage) -> None:
        """Refuse images whose surfaces are not marked, or without the labels or the reflectance to be learned."""
        reflectance = self._marked(images)[1] if self.needs_marks else images.reflectance
        if self.raydrop.classes is not None:
            labels_to_learn(images.label)
        if self.raydrop.config.reflectance:
            required_reflectance(reflectance, _SETTING)

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return the loss, and beside it the bits of a surface's return, and the mean absolute error of reflectance."""
        images = example.images
        if self.needs_marks:
            surfaces, (returned, reflectance) = images, self._marked(images)
        else:
            surfaces, returned, reflectance = ranges_from_others(images, rng), images.return_mask, images.reflectance
        range_m, surface = surfaces.range_m, surfaces.return_mask
        if self.training:
            noise = torch.randn(range_m.shape, generator=rng, device=rng.device)
            most = torch.rand((len(range_m), 1, 1), generator=rng, device=rng.device) * _NOISE_M
            range_m = (range_m + noise * most).clamp(min=images.sensor.range_min_m)
        label = None
        if self.raydrop.classes is not None:
            label = hidden_in_some(labels_to_learn(images.label), 0, _WITHOUT_LABELS, rng)
        network = self.raydrop.for_sensor(images.sensor)
        found = network(range_m, surface, label)
        count = surface.float().sum((1, 2)).clamp(min=1)
        nats = network.mask.nats(found.guide, network.padded(returned), rng if self.training else None) / count
        alone = F.binary_cross_entropy_with_logits(found.logits, returned.float(), reduction="none")
        alone = (alone * surface).sum((1, 2)) / count
        bits = {"mask_bits": nats.mean().detach() / math.log(2), "alone_bits": alone.mean().detach() / math.log(2)}
        each = nats + _ALONE_WEIGHT * alone
        if found.reflectance is not None:
            true = required_reflectance(reflectance, _SETTING)
            error = reflectance_error(found.reflectance, true, returned & surface)
            each, bits["reflectance_error"] = each + _REFLECTANCE_WEIGHT * error, error.mean().detach()
        return {"loss": each.mean(), **bits}

    def _marked(self, images: RangeImage) -> tuple[Bool[Tensor, "B H W"], Float[Tensor, "B H W"] | None]:
        """Return which surfaces return, and the reflectance of these if it is known."""
        if images.reflectance is not None and images.reflectance.is_meta:  # where operations are only counted
            return images.return_mask, images.reflectance
        marked = None if images.reflectance is None else marks.read_marks(images.reflectance)
        if marked is None or not marked.is_clear:
            raise ConfigError(
                "training scans that do not mark which of their surfaces return",
                f"scans of every surface, with {marks.WORDS}",
                "name such scans, as data.train=simulated_surfaces:512:train, or set model.raydrop.surfaces=estimated",
            )
        if self.raydrop.config.reflectance and not marked.has_reflectance:
            raise ConfigError(
                f"surfaces that are marked as returns without their reflectance, for {_SETTING}=true",
                marks.WORDS,
                f"name such scans, as data.train=simulated_surfaces:512:train, or leave {_SETTING} out",
            )
        return images.return_mask & marked.returned, marked.reflectance


@dataclass(frozen=True)
class RaydropConfig(Settings):
    """The network, which is the whole system."""

    raydrop: RaydropNetworkConfig = field(default_factory=RaydropNetworkConfig)


class Raydrop(Generator[RaydropConfig, SamplingSettings]):
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
    has_new_scans = False

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

    def _complete(self, condition: Observed, seeds: BatchSeeds, sampling: SamplingSettings) -> RangeImage:
        if not bool((condition.range_observed | condition.return_observed).all()):
            raise ConfigError(
                "scans with rays of which nothing is known",
                "the range of each surface, and which rays meet none",
                "take clean scans of the whole circle, or a model that completes scans",
            )
        own = slice(seeds.num_asked_for)  # copies would take as long, since scans are sampled one by one
        return self.raydrop.sample(condition[own], rngs_of(seeds[own]))

    def cost(self, sampling: SamplingSettings | None = None) -> Cost:
        """Return the cost of the features and of all phases of the mask, counted while they are computed."""
        range_m = torch.full((1, self.sensor.height, self.sensor.width), self.sensor.range_max_m)
        clean = RangeImage(range_m, range_m > 0, self.sensor).to(self.device)
        with torch.no_grad(), FlopCounter() as counter:
            self.raydrop.sample(Observed.of_surfaces(clean), [torch.Generator()])
        return Cost(1 + len(self.raydrop.mask.phases), counter.total)
