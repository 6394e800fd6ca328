"""A network that completes scans: observed pixels → range images, by triangulation and a U-Net."""

import math
from dataclasses import dataclass, field, replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidargrit.core.configuration import Settings
from lidargrit.generation.any_sensor import RayObjective
from lidargrit.generation.batches import BatchSeeds
from lidargrit.generation.facts import Cost, SamplingSettings, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective, hidden_in_some
from lidargrit.generation.reflectance import TYPICAL_REFLECTANCE, reflectance_error, required_reflectance
from lidargrit.generation.semantic_classes import class_indices, labels_to_learn
from lidargrit.nn.flops import FlopCounter
from lidargrit.nn.random import of_host, rngs_of
from lidargrit.scans.condition import Observed
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.systems.completion.classical_features import classical_features
from lidargrit.systems.completion.network import CompletionNetwork, CompletionNetworkConfig

_ROW_STEPS = (2, 4, 4, 8)  # one of so many rows is observed; four as often as the others together
_KINDS = (0.36, 0.74)  # up to these: rows, then sectors, then pixels
_BOXES = 1 / 3  # of the sectors, hidden in some rows only
_SECTORS = (24 / 256, 128 / 256)  # of the columns, hidden
_SHARES = (0.03, 0.5)  # of the pixels, observed
_SETTING = "model.completion.reflectance"
_WITHOUT = 0.25  # of the scans show no labels, and as many no reflectance, so that a network completes without them
_CLASS_WEIGHT, _REFLECTANCE_WEIGHT = 0.5, 2.0
_MASK_WEIGHT, _ALONE_WEIGHT, _LOG_WEIGHT, _METRE_WEIGHT = 3.0, 0.5, 1.5, 0.3


class CompletionObjective(RayObjective):
    """The errors of the hidden pixels: of the range, and of the mask, by its likelihood in phases and pixel by pixel.

    Every scan has a random pattern: rows, all but a sector or a box, or single pixels. Scans are weighed by the square
    root of their hidden share.
    """

    additions = frozenset({"labels", "reflectance", "any_sensor"})
    reaches_all_weights = False  # some phases stand for all

    def __init__(self, network: CompletionNetwork, sensor: SensorModel) -> None:
        super().__init__(sensor)
        self.completion = network

    def check(self, images: RangeImage) -> None:
        """Refuse images without the labels or the reflectance that are to be learned."""
        if self.completion.config.labels:
            labels_to_learn(images.label)
        if self.completion.config.reflectance:
            required_reflectance(images.reflectance, _SETTING)

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return the loss, and beside it the error in metres of hidden returns and the bits of a hidden return.

        A network with classes is told those of observed pixels in three of four scans; beside the loss then stands the
        share of hidden returns whose class it finds. Reflectance is told as often; beside the loss then stands its mean
        absolute error.
        """
        images, rng = example.images, of_host(rng)
        network = self.completion.for_sensor(images.sensor)
        observed = random_patterns(len(images), images.sensor.height, images.sensor.width, rng)
        # Features are searched for on the host, so all that they need is brought there once.
        condition, learned = Observed.of_pixels(images.to("cpu"), observed), self.completion.config
        planes = dict[str, Tensor]()  # no features are computed of what the network does not see
        if learned.labels:
            planes["label"] = hidden_in_some(labels_to_learn(condition.label), 0, _WITHOUT, rng)
        if learned.reflectance:
            shown = required_reflectance(condition.reflectance, _SETTING)
            planes["reflectance"] = hidden_in_some(shown, TYPICAL_REFLECTANCE, _WITHOUT, rng)
        condition = replace(condition, planes=planes)
        observed = observed.to(images.range_m.device)
        point = network(classical_features(condition, images.range_m.device), observed)
        hidden = ~observed
        returns = (hidden & images.return_mask).float()
        count, num_returns = hidden.sum((1, 2)).clamp(min=1), returns.sum((1, 2)).clamp(min=1)
        true = network.padded(images.return_mask)
        nats = network.mask.nats(point.guide, true, rng if self.training else None) / count
        alone = F.binary_cross_entropy_with_logits(point.return_logits, images.return_mask.float(), reduction="none")
        alone = (alone * hidden).sum((1, 2)) / count
        log_error = ((point.v - images.range_m.log1p()).abs() * returns).sum((1, 2)) / num_returns
        error_m = ((point.v.expm1() - images.range_m).abs() * returns).sum((1, 2)) / num_returns
        of_mask = _MASK_WEIGHT * (nats + _ALONE_WEIGHT * alone)
        weight = hidden.float().mean((1, 2)).sqrt()
        each = of_mask + _LOG_WEIGHT * log_error + _METRE_WEIGHT * error_m
        beside = {"error_m": error_m.mean().detach(), "mask_bits": nats.mean().detach() / math.log(2)}
        if point.class_logits is not None:
            of_classes, beside["class_accuracy"] = _class_terms(
                point.class_logits, labels_to_learn(images.label), hidden
            )
            each = each + _CLASS_WEIGHT * of_classes
        if point.reflectance is not None and images.reflectance is not None:
            error = reflectance_error(point.reflectance, images.reflectance, hidden & images.return_mask)
            each, beside["reflectance_error"] = each + _REFLECTANCE_WEIGHT * error, error.mean().detach()
        return {"loss": (weight * each).mean(), **beside}


def _class_terms(
    logits: Float[Tensor, "B 19 H W"], label: Int[Tensor, "B H W"], hidden: Bool[Tensor, "B H W"]
) -> tuple[Float[Tensor, " B"], Float[Tensor, ""]]:
    """Return the cross-entropy of hidden pixels of each scan in nats, and the share of right classes, of known ones."""
    wanted = class_indices(label)
    counted = ((wanted > 0) & hidden).float()
    nats = F.cross_entropy(logits, (wanted - 1).clamp(min=0), reduction="none")
    right = (logits.detach().argmax(1) + 1 == wanted) * counted
    return (nats * counted).sum((1, 2)) / counted.sum((1, 2)).clamp(min=1), right.sum() / counted.sum().clamp(min=1)


def random_patterns(count: int, height: int, width: int, rng: torch.Generator) -> Bool[Tensor, "B H W"]:
    """Return masks of observed pixels for training: some rows, all but a sector or a box of it, or single pixels.

    Args:
        rng: random numbers of the host (:func:`~lidargrit.nn.random.of_host`).
    """

    def uniform() -> float:
        return float(torch.rand((), generator=rng))

    masks = []
    for _ in range(count):
        kind, first, second, third = uniform(), uniform(), uniform(), uniform()
        mask = torch.zeros(height, width, dtype=torch.bool)
        if kind < _KINDS[0]:
            step = _ROW_STEPS[int(first * len(_ROW_STEPS))]
            mask[int(second * step) :: step] = True
        elif kind < _KINDS[1]:
            hidden = round(width * (_SECTORS[0] + first * (_SECTORS[1] - _SECTORS[0])))
            mask[:, hidden:] = True
            if third < _BOXES:
                top, bottom = int(uniform() * height / 2), height // 2 + int(uniform() * height / 2)
                mask[:top], mask[bottom:] = True, True
            mask = mask.roll(int(second * width), 1)
        else:
            share = _SHARES[0] * (_SHARES[1] / _SHARES[0]) ** first
            mask = torch.rand(height, width, generator=rng) < share
        masks.append(mask)
    return torch.stack(masks)


@dataclass(frozen=True)
class CompletionConfig(Settings):
    """The network, which is the whole system."""

    completion: CompletionNetworkConfig = field(default_factory=CompletionNetworkConfig)


class Completion(Generator[CompletionConfig, SamplingSettings]):
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
    has_new_scans = False

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

    def _complete(self, condition: Observed, seeds: BatchSeeds, sampling: SamplingSettings) -> RangeImage:
        return self.completion.sample(condition, rngs_of(seeds[: seeds.num_asked_for]))  # one by one

    def cost(self, sampling: SamplingSettings | None = None) -> Cost:
        """Return the cost of two estimates of the range and all phases of the mask, counted while it is computed."""
        nothing = Observed.nothing(self.sensor, 1).to(self.device)
        with torch.no_grad(), FlopCounter() as counter:
            self.completion.sample(nothing, [torch.Generator()])
        return Cost(2 + len(self.completion.mask.phases), counter.total)
