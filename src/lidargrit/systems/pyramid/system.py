"""Nearest ranges from coarse to fine: seeds → range images, each level given the one of half its size."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from lidargrit.core.configuration import Settings
from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Bounds, Count
from lidargrit.core.untrusted import TEMPERATURE_AT_LEAST
from lidargrit.generation.batches import BatchSeeds
from lidargrit.generation.facts import Cost, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective
from lidargrit.generation.pixel_decoder.pixel_decoder import PixelSampling, nats_to_range_bits
from lidargrit.generation.pixel_decoder.pixel_networks import PixelDecoderConfig
from lidargrit.generation.range_steps import RangeSteps
from lidargrit.nn.precision import inference
from lidargrit.nn.random import of_host, rngs_of
from lidargrit.scans.bits import ScanBits
from lidargrit.scans.condition import Condition
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import Decoded, RangeImage
from lidargrit.systems.pyramid.network import Level, ParentNetwork, halved_sensor, nearest_of_four

_ROW_HALVINGS = 2  # of a level's phases: then pixels above one another know of one another, as those of a pole have to
_LEVELS_AT_MOST = 16
_SHARES = (1 / 64, 1 / 32, 1 / 8)  # of the scans, from which the finest levels learn: they have the most pixels


@dataclass(frozen=True)
class PyramidConfig(Settings):
    """The levels and their networks.

    Args:
        levels: number of images, each of half as many rows and columns as the one before.
        pixels: sizes of the pixel decoder of the finest level, the scan itself.
        coarse_range_width: number of channels of the range networks of all coarser levels.
        top_range_width: number of channels of that of the coarsest level, which is given nothing.
        parent_width: number of channels of the network that each level but the coarsest has over the coarser one.
        parent_blocks: number of its residual blocks.
        finest_parent_width: number of channels of that network for the scan itself.
        coarse_range_temperature: temperature at which coarser levels are sampled where the caller names none, as
            ``pixels.range_temperature`` is that of the finest. Sampled at 1, they bring ranges that lie between
            surfaces, and finer levels keep them.
    """

    levels: Annotated[int, Bounds(2, _LEVELS_AT_MOST)] = 6
    pixels: PixelDecoderConfig = field(default_factory=PixelDecoderConfig)
    coarse_range_width: Count = 48
    top_range_width: Count = 64
    parent_width: Count = 48
    parent_blocks: Count = 4
    finest_parent_width: Count = 32
    coarse_range_temperature: Annotated[float, Bounds(TEMPERATURE_AT_LEAST)] = 0.5


class Pyramid(Generator[PyramidConfig, PixelSampling]):
    """Range images of nearest ranges, from coarse to fine: first what is near, then what stands behind it.

    A pixel of a coarser level has the nearest range of 2x2 pixels of the finer one. So what is thin and near, such as
    a pole, stands at every level, and a finer level only decides which of four pixels it fills, where a mean or every
    second pixel would lose it. Each level is a pixel decoder given all coarser levels.

    Source:
        Reed et al., Parallel Multiscale Autoregressive Density Estimation, 2017, for levels and phases; there each
        level keeps every second pixel.
    """

    Config = PyramidConfig
    facts = SystemFacts(generates="range and raydrop, nearest ranges first, from coarse to fine")
    Sampling = PixelSampling
    capabilities = frozenset({"likelihood"})
    trains = (("levels", "levels"),)

    def __init__(self, config: PyramidConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        least = 2**config.levels
        if sensor.height % least or sensor.width % least:
            raise ConfigError(
                f"range images of {sensor.height}x{sensor.width} for {config.levels} levels",
                f"rows and columns divisible by {least}",
                "lower levels, or choose another number of columns",
            )
        sensors = [sensor]
        with torch.device("cpu"):  # rays are numbers also where networks are built without values
            for _ in range(config.levels - 1):
                sensors.append(halved_sensor(sensors[-1]))
        self.levels = nn.ModuleList(_level(config, number, sensors) for number in range(config.levels))

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> PyramidConfig:
        """Return two levels of eight channels and one block."""
        pixels = PixelDecoderConfig(mask_features=2, range_features=2, mask_width=8, range_width=8, blocks=1)
        return PyramidConfig(2, pixels, 8, 8, 8, 1, 8)

    def objective(self, stage: str) -> Objective:
        """Return the negative log-likelihood of all levels."""
        return PyramidObjective(self.levels, self.sensor) if stage == "levels" else super().objective(stage)

    def _sample(self, seeds: BatchSeeds, condition: Condition, sampling: PixelSampling) -> RangeImage:
        return self._sampled([], rngs_of(seeds), sampling)

    @inference()
    def resample(self, images: RangeImage, seeds: Sequence[int], levels: int = 2) -> RangeImage:
        """Return scans whose finest levels are sampled given the true coarser ones, which tell what these keep.

        Args:
            levels: number of levels that are sampled.
        """
        every, made = levels_of(self.levels), []
        for index, seed in enumerate(seeds):
            true = images_of(every, images[[index]].to(self.device))[levels:]
            made.append(self._sampled(true, [torch.Generator().manual_seed(seed)], PixelSampling()))
        return RangeImage.cat(made)

    def _sampled(self, true: list[RangeImage], rngs: Sequence[torch.Generator], sampling: PixelSampling) -> RangeImage:
        """Return scans sampled below the true images of coarse levels, the finest of them first, if there are any."""
        coarser, told = None, None
        for number, level in reversed(list(enumerate(levels_of(self.levels)))):
            known = number - len(self.levels) + len(true)
            if known >= 0:
                told, coarser = level.guided(coarser, told)[1], true[known]
            else:
                coarser, told = level.sample(coarser, told, rngs, sampling)
        assert coarser is not None
        return coarser

    def _bits(self, images: RangeImage, steps: RangeSteps, expected: bool) -> ScanBits:
        """Return the bits of mask and ranges given the coarser level, and those of all coarser levels as tokens."""
        levels = levels_of(self.levels)
        pyramid = images_of(levels, images)
        guides = guides_of(levels, pyramid)
        coarser: Float[Tensor, "B h w"] | None = None
        for level, image, guide in zip(levels[1:], pyramid[1:], guides[1:], strict=True):
            mask, range_, _ = level.pixels.bits(guide, image, steps, False)
            bits = mask + range_
            # all bits of a cell of the coarsest level stand there together
            while bits.shape[-1] > levels[-1].sensor.width:
                bits = 4 * F.avg_pool2d(bits[:, None], 2)[:, 0]
            coarser = bits if coarser is None else coarser + bits
        assert coarser is not None
        finest = levels[0].pixels.bits(guides[0], images, steps, expected)
        return ScanBits(steps.step_mm, images.return_mask, coarser, *finest)

    def cost(self, sampling: PixelSampling | None = None) -> Cost:
        """Return the cost of all phases of all levels."""
        levels = levels_of(self.levels)
        evaluations = sum(level.pixels.num_evaluations + (level.parent is not None) for level in levels)
        return Cost(evaluations, sum(level.flops() for level in levels))


class PyramidObjective(Objective):
    """Negative log-likelihood of every level, each given the true coarser levels.

    In training the three finest levels learn from one scan in 64, in 32 and in 8: coarser ones have fewer pixels to
    learn from. A batch that has no scan for a level leaves that level's weights as they are.

    Args:
        levels: the levels, the finest first.
    """

    reaches_all_weights = False  # some phases stand for all

    def __init__(self, levels: nn.ModuleList, sensor: SensorModel) -> None:
        super().__init__(sensor)
        self.levels = levels

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return the sum over levels of nats of the mask a pixel, and of the range a pixel, as ``loss``.

        In evaluation, beside it are the bits of every level, given the coarser ones: a pixel's mask and a return's
        range. Those of the scan itself have plain names, those of others the number of rows behind.
        """
        levels = levels_of(self.levels)
        pyramid = images_of(levels, example.images)
        if self.training:
            return {"loss": self._estimate(levels, pyramid, rng)}
        loss = example.images.range_m.new_zeros(())
        terms: dict[str, Tensor] = {}
        for level, images, guide in zip(levels, pyramid, guides_of(levels, pyramid), strict=True):
            nll = level.pixels(guide, images)
            returns = images.return_mask.sum()
            loss = loss + nll.mask.mean() + nll.range.sum() / images.return_mask.numel()
            rows = f"_{level.sensor.height}" if terms else ""
            terms[f"mask_bits{rows}"] = nll.mask.mean() / math.log(2)
            terms[f"range_bits{rows}"] = nats_to_range_bits(nll.range.sum() / returns.clamp(min=1))
        return {"loss": loss, **terms}

    def _estimate(self, levels: list[Level], pyramid: list[RangeImage], rng: torch.Generator) -> Tensor:
        rng = of_host(rng)  # once, so that levels choose apart
        chance = float(torch.rand((), generator=rng))
        shares = (_SHARES[: len(levels) - 1] + (1.0,) * len(levels))[: len(levels)]
        counts = [int(len(pyramid[0]) * share + chance) for share in shares]
        learned = [images[:count] for images, count in zip(pyramid, counts, strict=True) if count]
        levels = levels[len(levels) - len(learned) :]
        loss = pyramid[0].range_m.new_zeros(())
        for level, images, guide in zip(levels, learned, guides_of(levels, learned), strict=True):
            mask_nats, range_nats = level.pixels.estimate(guide, images, rng)
            loss = loss + mask_nats + images.return_mask.float().mean() * range_nats
        return loss


def levels_of(modules: nn.ModuleList) -> list[Level]:
    """Return the levels, the finest first."""
    return [level for level in modules if isinstance(level, Level)]


def images_of(levels: list[Level], images: RangeImage) -> list[RangeImage]:
    """Return the range images of all levels, those of the scans first."""
    found = [images]
    for level in levels[1:]:
        found.append(nearest_of_four(found[-1], level.sensor))
    return found


def guides_of(levels: list[Level], pyramid: list[RangeImage]) -> list[Decoded | None]:
    """Return what each level is told by the images of all coarser ones, the finest first.

    Args:
        pyramid: images of all levels, the finest first; a finer level may have fewer of them, the first ones.
    """
    guides: list[Decoded | None] = []
    told: Float[Tensor, "B D h w"] | None = None
    for level, images, coarser in zip(reversed(levels), reversed(pyramid), [None, *reversed(pyramid[1:])], strict=True):
        count = len(images)
        guide, told = level.guided(None if coarser is None else coarser[:count], None if told is None else told[:count])
        guides.append(guide)
    return guides[::-1]


def _level(config: PyramidConfig, number: int, sensors: list[SensorModel]) -> Level:
    sensor, finest = sensors[number], config.pixels
    coarse = replace(
        finest,
        surface_components=False,
        gravity_components=False,
        range_width=config.coarse_range_width,
        range_temperature=config.coarse_range_temperature,
    )
    if number == len(sensors) - 1:
        rows, columns = (size & -size for size in (sensor.height, sensor.width))  # the largest powers of 2 in them
        halvings = {"column_halvings": 0, "row_halvings": 0}
        if rows != columns:
            side = "column_halvings" if columns > rows else "row_halvings"
            halvings[side] = (max(rows, columns) // min(rows, columns)).bit_length() - 1
        nothing_told = {"decoded_components": False, "weighed_components": False}
        top = replace(coarse, range_width=config.top_range_width, **nothing_told, **halvings)
        return Level(sensor, replace(top, coarsest_cell=min(rows, columns)), None)
    halvings = min(_ROW_HALVINGS, ((sensor.height & -sensor.height) // 2).bit_length() - 1)
    decoder = replace(coarse if number else finest, coarsest_cell=2, column_halvings=0, row_halvings=halvings)
    width = config.parent_width if number else config.finest_parent_width
    coarser = 0 if number == len(sensors) - 2 else config.parent_width
    parent = ParentNetwork(sensor.height // 2, width, config.parent_blocks, decoder.range_features, coarser)
    return Level(sensor, decoder, parent)
