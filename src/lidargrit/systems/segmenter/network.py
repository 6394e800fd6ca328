"""The network of the segmenter: ranges of the returns, and their reflectance if it is known → the class of each."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from lidargrit.core.configuration import Settings
from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Count, NotNegative
from lidargrit.generation.reflectance import TYPICAL_REFLECTANCE
from lidargrit.generation.semantic_classes import NUM_CLASSES, labels_of
from lidargrit.nn.small_unet import Part, SmallUnet, SmallUnetConfig, check_size
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import TYPICAL_LOG_RANGE, RangeImage

_NUM_MAPS = 4
_HEIGHT_M = 3.0  # the scale of heights: what stands on the ground is about so high
_HEIGHTS_AT_MOST = 4.0  # times that


@dataclass(frozen=True)
class SegmenterNetworkConfig(Settings):
    """Sizes of the segmenter's network, and what it sees.

    Args:
        widths: channels at a half, a quarter and an eighth of the image's rows and columns.
        blocks: residual blocks at an eighth.
        attention_layers: layers of attention between all pixels at an eighth, among the residual blocks.
        heads: attention heads of each layer.
        reflectance: whether the network sees the reflectance of returns, where scans have it.
    """

    widths: tuple[Count, Count, Count] = (32, 64, 96)
    blocks: Count = 2
    attention_layers: NotNegative = 1
    heads: Count = 4
    reflectance: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.attention_layers > self.blocks:
            got = f"attention_layers={self.attention_layers}, blocks={self.blocks}"
            raise ConfigError(got, "at most a layer of attention a block", "change one")


class SegmenterNetwork(nn.Module):
    """A small U-Net over the returns of a scan: range, height above the sensor, and elevation of every pixel.

    Args:
        config: sizes of the network.
        sensor: the rays and limits of the range images.

    Source:
        the inputs of Milioto et al., RangeNet++, IROS 2019, without x and y, which tell where the scan turns.
    """

    def __init__(self, config: SegmenterNetworkConfig, sensor: SensorModel) -> None:
        super().__init__()
        check_size(sensor.height, sensor.width, "a segmenter")
        self.config = config
        self.register_buffer("elevation_rad", sensor.elevation_rad.double().mean(1).float(), persistent=False)
        sizes = SmallUnetConfig(config.widths, config.blocks, config.attention_layers, config.heads)
        parts = {"reflectance": Part(2, 0)} if config.reflectance else {}
        self.unet = SmallUnet(sizes, _NUM_MAPS, NUM_CLASSES, parts)

    elevation_rad: Tensor

    def forward(
        self, range_m: Float[Tensor, "B H W"], reflectance: Float[Tensor, "B H W"] | None = None
    ) -> Float[Tensor, "B 19 H W"]:
        """Return a logit for each of the benchmark's classes at every pixel.

        Args:
            range_m: ranges in metres, 0 where nothing returned.
            reflectance: reflectance of the returns, NaN where it is not known; None if it is known of none.
        """
        more = dict[str, Tensor]()
        if self.config.reflectance:
            known = torch.zeros_like(range_m) if reflectance is None else reflectance.isfinite().to(range_m.dtype)
            value = torch.zeros_like(range_m) if reflectance is None else reflectance - TYPICAL_REFLECTANCE
            more["reflectance"] = torch.stack((known, torch.where(known > 0, value, 0.0)), 1)
        logits, _ = self.unet(self._maps(range_m), more)
        return logits.float()

    def classes(self, images: RangeImage) -> Int[Tensor, "B H W"]:
        """Return the likeliest class of each return, by SemanticKITTI's numbers; 0 where nothing returned."""
        label = labels_of(self(images.range_m, images.reflectance).argmax(1) + 1)
        return torch.where(images.return_mask, label, 0)

    def _maps(self, range_m: Float[Tensor, "B H W"]) -> Float[Tensor, "B 4 H W"]:
        """Return maps of returns, their ranges and heights, and the elevations of the rays."""
        returned = range_m > 0
        elevation = self.elevation_rad[:, None].expand_as(range_m)
        height = (range_m * elevation.sin() / _HEIGHT_M).clamp(-_HEIGHTS_AT_MOST, _HEIGHTS_AT_MOST)
        near = torch.where(returned, range_m.log1p() - TYPICAL_LOG_RANGE, 0.0)
        return torch.stack((returned.to(range_m.dtype), near, height, 5 * elevation), 1)
