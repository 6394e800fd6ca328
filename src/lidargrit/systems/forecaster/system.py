"""The next scan of a drive by a pixel decoder that is given the past: seeds, past → range images with exact bits."""

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from lidargrit.core.configuration import Settings
from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.typed_values import Count, Share
from lidargrit.data.images import RangeImages
from lidargrit.generation.batches import BatchSeeds
from lidargrit.generation.facts import Cost, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective
from lidargrit.generation.pixel_decoder.phase_network import PixelDecoderConfig
from lidargrit.generation.pixel_decoder.pixel_decoder import PixelDecoder, PixelSampling
from lidargrit.generation.range_steps import RangeSteps
from lidargrit.generation.tokens import PixelObjective
from lidargrit.nn.random import rngs_of
from lidargrit.scans.bits import ScanBits
from lidargrit.scans.condition import Condition, Nothing
from lidargrit.scans.example import Example
from lidargrit.scans.past import Past
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import Decoded, RangeImage
from lidargrit.scans.warp import warp
from lidargrit.systems.forecaster.network import COMPONENTS, PastNetwork
from lidargrit.systems.forecaster.own_past import with_own
from lidargrit.systems.forecaster.start import behind_past
from lidargrit.systems.forecaster.worn_past import jittered, worn

_COUNTED_SCANS = 2000
_UNSEEN = 0.1  # returns, and as many drops, that are counted besides


@dataclass(frozen=True)
class ForecasterConfig(Settings):
    """The networks of the forecaster.

    Args:
        pixels: sizes of the pixel decoder.
        past_scans: number of past scans that a scan is given, in training and afterwards.
        past_width: number of channels of the network over what past scans have on the present rays.
        past_blocks: number of its residual blocks.
        own_past: share of the examples of training whose past ends with scans that the model samples itself, so that
            generated drives do not fall apart; they are slow, and the model is to know something before.
    """

    pixels: PixelDecoderConfig = field(default_factory=lambda: PixelDecoderConfig(decoded_components=True))
    past_scans: Count = 5
    past_width: Count = 24
    past_blocks: Count = 2
    own_past: Share = 0.0


class Forecaster(Generator[ForecasterConfig, PixelSampling]):
    """Mask and ranges of the next scan of a drive with exact probabilities, given past scans and the sensor's motion.

    Past returns are moved onto the rays of the present scan. A pixel decoder sees maps of them, and three components of
    its distributions begin at their ranges. Without a past it generates the first scan of a drive.
    """

    Config = ForecasterConfig
    trains = (("pixels", "pixels", "past"),)
    facts = SystemFacts(
        generates="range and raydrop of the next scan of a drive, given its past scans and poses",
        first_command="sample RUN drives -n 1 --frames 20",
    )
    Sampling = PixelSampling
    capabilities = frozenset({"likelihood"})

    def __init__(self, config: ForecasterConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        self.pixels = PixelDecoder(config.pixels, sensor, config.past_width, COMPONENTS, gaps=True)
        self.past = PastNetwork(sensor.height, sensor.width, config.past_width, config.past_blocks, config.past_scans)

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> ForecasterConfig:
        """Return networks of eight channels and one block."""
        sizes = PixelDecoderConfig(mask_features=2, range_features=2, mask_width=8, range_width=8, blocks=1)
        return ForecasterConfig(replace(sizes, decoded_components=True), past_scans=2, past_width=8, past_blocks=1)

    @property
    def past_scans(self) -> int:
        """Number of past scans, as the configuration says."""
        return self.config.past_scans

    def fit_statistics(self, images: RangeImages) -> None:
        """Take how often each ray returns in the training scans."""
        indices = evenly_spaced(_COUNTED_SCANS, len(images))
        total = torch.zeros_like(self.past.usual)
        for index in indices:
            total += images.batch([index]).return_mask[0]
        self.past.usual.copy_(((total + _UNSEEN) / (len(indices) + 2 * _UNSEEN)).logit())

    def objective(self, stage: str) -> Objective:
        """Return the negative log-likelihood of the pixels."""
        return ForecasterObjective(self.pixels, self.past, self.config.own_past)

    def told(self, condition: Condition, count: int) -> Decoded:
        """Return what the past tells of each pixel of a number of scans."""
        past = condition if isinstance(condition, Past) else Past.nothing(self.sensor, count, 1).to(self.device)
        return self.past.told(warp(past), self.sensor)

    def _sample(self, seeds: BatchSeeds, condition: Condition, sampling: PixelSampling) -> RangeImage:
        return self.pixels.sample(self.told(condition, len(seeds)), rngs_of(seeds), sampling)

    def _bits(self, images: RangeImage, steps: RangeSteps, expected: bool) -> ScanBits:
        """Return the bits of mask and ranges of scans without a past."""
        return self._bits_given(images, Nothing(), steps, expected)

    def _bits_given(self, images: RangeImage, condition: Condition, steps: RangeSteps, expected: bool) -> ScanBits:
        """Return the bits of mask and ranges; there are no tokens, which take none."""
        no_tokens = images.range_m.new_zeros(len(images), 1, 1)
        bits = self.pixels.bits(self.told(condition, len(images)), images, steps, expected)
        return ScanBits(steps.step_mm, images.return_mask, no_tokens, *bits)

    def cost(self, sampling: PixelSampling | None = None) -> Cost:
        """Return the cost of all phases, and of the network over the past."""
        return Cost(1 + self.pixels.num_evaluations, self.pixels.flops() + self.past.flops(self.sensor))


class ForecasterObjective(PixelObjective):
    """Negative log-likelihood of the pixels given their past, which in training is left out, worn or displaced."""

    kin = (PixelObjective,)

    def __init__(self, pixels: PixelDecoder, past: PastNetwork, own_past: float) -> None:
        super().__init__(pixels)
        self.past, self._own_past = past, own_past

    def weights_from(self, trained: Objective) -> dict[str, Tensor]:
        """Return the weights of a trained forecaster, or what fits of a pixel decoder behind a tokenizer."""
        if isinstance(trained, ForecasterObjective):
            kept = super().weights_from(trained)
            return {name: weight for name, weight in kept.items() if name != "past.usual"}  # of the scans at hand
        return behind_past(trained.state_dict(), self.state_dict())

    def decoded(self, example: Example, rng: torch.Generator) -> Decoded:
        """Return what the past tells of each scan."""
        past = example.condition
        if not isinstance(past, Past):
            past = Past.nothing(self.sensor, len(example), 1).to(example.images.range_m.device)
        if self.training:
            past = worn(with_own(past, self._own_past, self._sampled, rng), rng)
        warped = warp(past)
        if self.training:
            warped = jittered(warped, rng)
        return self.past.told(warped, self.sensor)

    @torch.no_grad()
    def _sampled(self, past: Past, seeds: list[int]) -> RangeImage:
        told = self.past.told(warp(past), self.sensor)
        return self.pixels.sample(told, rngs_of(seeds), PixelSampling(range_temperature=1.0))  # others take longer
