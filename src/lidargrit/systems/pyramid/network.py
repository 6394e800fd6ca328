"""Levels of a pyramid of nearest ranges: range images → images of half the size, and the networks that double them."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from lidargrit.generation.pixel_decoder.pixel_decoder import PixelDecoder, PixelSampling
from lidargrit.generation.pixel_decoder.pixel_networks import LOGIT_BOUND, PixelDecoderConfig
from lidargrit.nn.blocks import Network
from lidargrit.nn.convolution import Convolution, Residual
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import TYPICAL_LOG_RANGE, Decoded, RangeImage

_HEAD_STARTS = (0.0, -1.0, -2.0, -2.0, -3.0)  # logits of the suggested ranges: mostly a pixel has that of its cell
_LOG_SCALE_M = -3.0  # 5 cm
_FARTHER_AT_MOST = 3.0  # from row to row of level ground; beyond, the ground is too far away to be seen


def halved_sensor(sensor: SensorModel) -> SensorModel:
    """Return the sensor of images of half as many rows and columns, each ray in the middle of four."""
    elevation, azimuth = sensor.elevation_rad, sensor.azimuth_rad
    elevation = elevation.unflatten(0, (-1, 2)).mean(1)
    azimuth = azimuth.unflatten(1, (-1, 2)).mean(2)
    if elevation.shape[1] > 1:
        elevation = elevation.unflatten(1, (-1, 2)).mean(2)
    if azimuth.shape[0] > 1:
        azimuth = azimuth.unflatten(0, (-1, 2)).mean(1)
    return replace(sensor, elevation_rad=elevation, azimuth_rad=azimuth, azimuth_offset_rad=None)


def nearest_of_four(images: RangeImage, halved: SensorModel) -> RangeImage:
    """Return images of half as many rows and columns: the nearest range of each 2x2 pixels, if any of them returned."""
    range_m = torch.where(images.return_mask, images.range_m, torch.inf)
    nearest = -F.max_pool2d(-range_m[:, None], 2)[:, 0]
    return RangeImage.masked(nearest.nan_to_num(posinf=0.0), nearest < torch.inf, halved)


class ParentNetwork(Network):
    """What the coarser levels tell of each pixel of a finer one: the image of half its size, and what the network of
    the next coarser level made of all coarser ones.

    Args:
        coarser: number of channels of the network of the next coarser level; 0 for the coarsest of these networks.
    """

    def __init__(self, rows: int, width: int, blocks: int, features: int, coarser: int) -> None:
        super().__init__()
        self.rows = nn.Parameter(torch.zeros(width, rows, 1))
        self.conv_in = Convolution(2 + coarser, width, "wrap")
        self.blocks = nn.Sequential(*(Residual(width) for _ in range(blocks)))
        self.conv_out = nn.Conv2d(width, 4 * (features + 1), 1)

    def forward(
        self, maps: Float[Tensor, "B 2 h w"], coarser: Float[Tensor, "B D g v"] | None
    ) -> tuple[Float[Tensor, "B C H W"], Float[Tensor, "B E h w"]]:
        """Return the features of every pixel, last among them the logit of a return; and what finer levels are told.

        Args:
            maps: mask and encoded range of the image of half the size.
            coarser: output of the network of the next coarser level for finer ones, of half the size again.
        """
        if coarser is not None:
            maps = torch.cat((maps, F.interpolate(coarser, scale_factor=2.0, mode="nearest")), 1)
        x = F.silu(self.blocks(self.conv_in(maps) + self.rows))
        return F.pixel_shuffle(self.conv_out(x), 2), x


class Level(nn.Module):
    """One level of the pyramid: its pixels, given those of all coarser levels.

    Args:
        parent: network over the coarser levels; None for the coarsest, which is given nothing.
    """

    def __init__(self, sensor: SensorModel, config: PixelDecoderConfig, parent: ParentNetwork | None) -> None:
        super().__init__()
        self.sensor, self.parent = sensor, parent
        features, components = (0, 1) if parent is None else (config.range_features, len(_HEAD_STARTS))
        self.pixels = PixelDecoder(config, sensor, features, components)

    def guided(
        self, coarser: RangeImage | None, told: Float[Tensor, "B D g v"] | None = None
    ) -> tuple[Decoded | None, Float[Tensor, "B E h w"] | None]:
        """Return what the coarser levels tell of each pixel, None at the coarsest level; and what to tell finer ones.

        Args:
            coarser: range images of half the size.
            told: output of the next coarser level for finer ones.
        """
        if self.parent is None or coarser is None:
            return None, None
        mask = coarser.return_mask
        v = torch.where(mask, coarser.range_m.log1p() - TYPICAL_LOG_RANGE, 0.0)
        output, tell = self.parent(torch.stack((mask.to(v.dtype), v), 1), told)
        returned = _doubled(mask)
        # A cell without a return has none in any of its pixels.
        logits = torch.where(returned, output[:, -1].float(), -LOGIT_BOUND)
        suggested_m = self.suggested_m(coarser)
        centres = suggested_m.log1p()
        starts = centres.new_tensor(_HEAD_STARTS)[:, None, None].expand_as(centres)
        components = torch.stack((starts, centres, _LOG_SCALE_M - centres), 1)
        return Decoded(suggested_m[:, 0], logits, self.sensor, features=output[:, :-1], components=components), tell

    def suggested_m(self, coarser: RangeImage) -> Float[Tensor, "B K H W"]:
        """Return ranges in metres that a pixel may have, by the coarser level.

        They are the nearest range of its own cell; that of level ground through the cell's lower row; and those of the
        three cells next to the pixel, beside it, above or below it, and across the corner: what stands behind an edge.
        Where a cell has no return, the pixel's own stands in; beyond the first and last row that row stands in.
        """
        own = torch.where(coarser.return_mask, coarser.range_m, math.expm1(TYPICAL_LOG_RANGE))
        beside = torch.stack((own.roll(1, 2), own.roll(-1, 2)), -1).flatten(-2)
        there = torch.stack((coarser.return_mask.roll(1, 2), coarser.return_mask.roll(-1, 2)), -1).flatten(-2)
        wide = own.repeat_interleave(2, 2)
        beside = torch.where(there, beside, wide)
        rows = [0, *range(len(own[0]) - 1)], [*range(1, len(own[0])), len(own[0]) - 1]
        wide_mask = coarser.return_mask.repeat_interleave(2, 2)

        def over(values: Tensor) -> Tensor:
            return torch.stack([values[:, index] for index in rows], 2).flatten(1, 2)

        tall = _rows_doubled(wide)
        above = torch.where(over(wide_mask), over(wide), tall)
        across = torch.where(over(there), over(beside), tall)
        down = (-self.sensor.elevation_rad.to(own)).sin()
        lower = _rows_doubled(down[None, 1::2])[0]
        farther = torch.where(down > 0, lower / down, 1.0)  # the upper row of level ground; 1 above the horizon
        ground = torch.where(farther < _FARTHER_AT_MOST, tall * farther, tall)
        return torch.stack((tall, ground, _rows_doubled(beside), above, across), 1)

    def sample(
        self,
        coarser: RangeImage | None,
        told: Float[Tensor, "B D g v"] | None,
        rngs: Sequence[torch.Generator],
        sampling: PixelSampling,
    ) -> tuple[RangeImage, Float[Tensor, "B E h w"] | None]:
        """Return one image for each random generator, and what to tell finer levels."""
        guide, tell = self.guided(coarser, told)
        return self.pixels.sample(guide, rngs, sampling), tell

    def flops(self) -> int:
        """Return the floating-point operations of sampling one image."""
        return self.pixels.flops() + (0 if self.parent is None else self._parent_flops(self.parent))

    def _parent_flops(self, parent: ParentNetwork) -> int:
        rows, columns = self.sensor.height // 2, self.sensor.width // 2
        layers = [layer for layer in parent.modules() if isinstance(layer, nn.Conv2d)]
        return 2 * rows * columns * sum(layer.weight.numel() for layer in layers)


def _rows_doubled(pixels: Tensor) -> Tensor:
    return pixels.repeat_interleave(2, 1)


def _doubled(pixels: Float[Tensor, "B h w"] | Bool[Tensor, "B h w"]) -> Tensor:
    return pixels.repeat_interleave(2, 1).repeat_interleave(2, 2)
