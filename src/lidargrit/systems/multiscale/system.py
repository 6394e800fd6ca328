"""A pixel decoder without tokens: seeds → range images from coarse to fine, each phase given all earlier ones."""

from dataclasses import dataclass, field

from lidargrit.core.configuration import Settings
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
from lidargrit.scans.condition import Condition, Observed
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage


@dataclass(frozen=True)
class MultiscaleConfig(Settings):
    """The networks of the pixel decoder, which is the whole system."""

    pixels: PixelDecoderConfig = field(default_factory=PixelDecoderConfig)


class Multiscale(Generator[MultiscaleConfig, PixelSampling]):
    """Mask and ranges with exact probabilities, in phases from coarse to fine, conditioned on nothing else.

    It tells what tokens are worth beside LidarGRIT with a pixel decoder, and compresses scans without a tokenizer.

    Source:
        Reed et al., Parallel Multiscale Autoregressive Density Estimation, 2017: phases from coarse to fine.
    """

    Config = MultiscaleConfig
    trains = (("pixels", "pixels"),)
    facts = SystemFacts(generates="range and raydrop, each pixel given all pixels of coarser phases")
    Sampling = PixelSampling
    capabilities = frozenset({"complete", "likelihood"})

    def __init__(self, config: MultiscaleConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        self.pixels = PixelDecoder(config.pixels, sensor, features=0)

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> MultiscaleConfig:
        """Return networks of eight channels and one block."""
        return MultiscaleConfig(PixelDecoderConfig(mask_width=8, range_width=8, blocks=1))

    def objective(self, stage: str) -> Objective:
        """Return the negative log-likelihood of the pixels."""
        return PixelObjective(self.pixels)

    def _sample(self, seeds: BatchSeeds, condition: Condition, sampling: PixelSampling) -> RangeImage:
        return self.pixels.sample(None, rngs_of(seeds), sampling)

    def _complete(self, condition: Observed, seeds: BatchSeeds, sampling: PixelSampling) -> RangeImage:
        return self.pixels.sample(None, rngs_of(seeds), sampling, condition)

    def _bits(self, images: RangeImage, steps: RangeSteps, expected: bool) -> ScanBits:
        """Return the bits of mask and ranges; there are no tokens, which take none."""
        no_tokens = images.range_m.new_zeros(len(images), 1, 1)
        return ScanBits(steps.step_mm, images.return_mask, no_tokens, *self.pixels.bits(None, images, steps, expected))

    def cost(self, sampling: PixelSampling | None = None) -> Cost:
        """Return the cost of all phases."""
        return Cost(self.pixels.num_evaluations, self.pixels.flops())
