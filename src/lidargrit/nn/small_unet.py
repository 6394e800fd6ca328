"""A small U-Net over range images, for maps of classical hints: maps at full size → maps at full size."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from lidargrit.errors import ConfigError
from lidargrit.nn.blocks import Network
from lidargrit.nn.convolution import Convolution
from lidargrit.nn.pixel_networks import Residual
from lidargrit.nn.transformer import TransformerBlock, TransformerConfig
from lidargrit.sensors import SensorModel

_CELL = 8  # rows and columns of an image are multiples of it


def check_image(sensor: SensorModel, wanted_by: str) -> None:
    """Refuse a sensor whose images cannot be halved three times, with ConfigError.

    Args:
        sensor: sensor of the images.
        wanted_by: name of the network, for the message.
    """
    if sensor.height % _CELL or sensor.width % _CELL:
        raise ConfigError(
            f"range images of {sensor.height}x{sensor.width} for {wanted_by}",
            f"rows and columns in multiples of {_CELL}",
            "choose another sensor or number of columns",
        )


@dataclass(frozen=True)
class SmallUnetConfig:
    """Sizes of the U-Net.

    Args:
        widths: channels at a half, a quarter and an eighth of the image's rows and columns.
        blocks: residual blocks at an eighth.
        attention_layers: layers of attention between all pixels at an eighth, among the residual blocks.
        heads: attention heads of each layer.
    """

    widths: tuple[int, int, int]
    blocks: int
    attention_layers: int = 0
    heads: int = 1


class SmallUnet(Network):
    """Maps at full size → maps at full size, through a half, a quarter and an eighth of the rows and columns.

    Args:
        config: sizes of the network.
        inputs: channels of the input.
        outputs: channels of the output.
        more_inputs: channels of further inputs, without influence at first, so that a network without them can be
            trained further with them.
        more_outputs: channels of further outputs, which come last and are 0 at first.
    """

    def __init__(
        self, config: SmallUnetConfig, inputs: int, outputs: int, more_inputs: int = 0, more_outputs: int = 0
    ) -> None:
        super().__init__()
        first, second, third = config.widths
        self.enter, self.level1 = Convolution(4 * inputs, first, "wrap"), Residual(first)
        self.down1, self.level2 = nn.Conv2d(4 * first, second, 1), Residual(second)
        self.down2 = nn.Conv2d(4 * second, third, 1)
        self.level3 = nn.Sequential()
        for index in range(config.blocks):
            self.level3.append(Residual(third))
            if index < config.attention_layers:
                self.level3.append(_Attention(TransformerConfig(1, config.heads, third, embedding_dropout=0.0)))
        self.up2, self.after2 = nn.Conv2d(third, 4 * second, 1), Residual(second)
        self.up1, self.after1 = nn.Conv2d(second, 4 * first, 1), Residual(first)
        self.out = nn.Conv2d(first, 4 * outputs, 1)
        nn.init.normal_(self.out.weight, std=0.02)
        assert self.out.bias is not None
        nn.init.zeros_(self.out.bias)
        self.more_in = nn.Conv2d(4 * more_inputs, first, 1, bias=False) if more_inputs else None
        self.more_out = nn.Conv2d(first, 4 * more_outputs, 1) if more_outputs else None
        if self.more_in is not None:
            nn.init.zeros_(self.more_in.weight)
        if self.more_out is not None:
            nn.init.zeros_(self.more_out.weight)
            assert self.more_out.bias is not None
            nn.init.zeros_(self.more_out.bias)

    def forward(
        self, maps: Float[Tensor, "B C H W"], more: Float[Tensor, "B E H W"] | None = None
    ) -> Float[Tensor, "B D H W"]:
        """Return the output at full size."""
        entered = self.enter(F.pixel_unshuffle(maps, 2))
        if self.more_in is not None and more is not None:
            entered = entered + self.more_in(F.pixel_unshuffle(more, 2))
        one = self.level1(entered)
        two = self.level2(self.down1(F.pixel_unshuffle(one, 2)))
        three = self.level3(self.down2(F.pixel_unshuffle(two, 2)))
        two = self.after2(two + F.pixel_shuffle(self.up2(three), 2))
        one = self.after1(one + F.pixel_shuffle(self.up1(two), 2))
        found = F.pixel_shuffle(self.out(F.silu(one)), 2)
        if self.more_out is None:
            return found
        return torch.cat((found, F.pixel_shuffle(self.more_out(F.silu(one)), 2)), 1)


class _Attention(nn.Module):
    """A layer of a transformer whose tokens are pixels; convolutions give them their positions."""

    def __init__(self, config: TransformerConfig) -> None:
        super().__init__()
        self.layer = TransformerBlock(config, causal=False)

    def forward(self, x: Float[Tensor, "B C h w"]) -> Float[Tensor, "B C h w"]:
        size = x.shape[-2:]
        return self.layer(x.flatten(2).transpose(1, 2)).transpose(1, 2).unflatten(2, size)
