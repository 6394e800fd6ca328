"""A small U-Net over range images, for maps of classical hints: maps at full size → maps at full size."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from lidargrit.core.configuration import Settings
from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Count, NotNegative
from lidargrit.nn.blocks import Network, zeroed
from lidargrit.nn.convolution import Convolution, Residual
from lidargrit.nn.transformer import TransformerBlock, TransformerConfig

_CELL = 8  # rows and columns of an image are multiples of it


def check_size(rows: int, columns: int, wanted_by: str) -> None:
    """Refuse images that cannot be halved three times, with ConfigError."""
    if rows % _CELL or columns % _CELL:
        raise ConfigError(
            f"range images of {rows}x{columns} for {wanted_by}",
            f"rows and columns in multiples of {_CELL}",
            "choose another sensor or number of columns",
        )


@dataclass(frozen=True)
class SmallUnetConfig(Settings):
    """Sizes of the U-Net, and base of the settings of networks around one.

    Args:
        widths: numbers of channels at a half, a quarter and an eighth of the image's rows and columns.
        blocks: number of residual blocks at an eighth of the image's size.
        attention_layers: number of attention layers between all pixels at an eighth of the image's size, among the
            residual blocks.
        heads: number of attention heads of each layer.

    Raises:
        ConfigError: more layers of attention than residual blocks, or heads that do not divide the last width.
    """

    widths: tuple[Count, Count, Count]
    blocks: Count
    attention_layers: NotNegative = 0
    heads: Count = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.attention_layers > self.blocks or (self.attention_layers and self.widths[-1] % self.heads):
            raise ConfigError(
                f"{self.attention_layers} layers of attention of {self.heads} heads, {self.widths[-1]} channels",
                f"at most {self.blocks} layers, one after each residual block, and heads that divide the channels",
                "change them, as in model.completion.heads=2 or model.segmenter.heads=2",
            )


class Part(NamedTuple):
    """Further inputs and outputs of a U-Net, which a U-Net without them can be trained further with.

    Args:
        inputs: channels of the further input, which has no influence at first; 0 for none.
        outputs: channels of the further output, which is 0 at first; 0 for none.
    """

    inputs: int
    outputs: int


class SmallUnet(Network):
    """Maps at full size → maps at full size, through a half, a quarter and an eighth of the rows and columns.

    Args:
        inputs: channels of the input.
        outputs: channels of the output.
        parts: further inputs and outputs by a name of their own.
    """

    def __init__(self, config: SmallUnetConfig, inputs: int, outputs: int, parts: Mapping[str, Part]) -> None:
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
        into = {name: nn.Conv2d(4 * part.inputs, first, 1, bias=False) for name, part in parts.items() if part.inputs}
        out_of = {name: nn.Conv2d(first, 4 * part.outputs, 1) for name, part in parts.items() if part.outputs}
        self.more_in, self.more_out = zeroed(nn.ModuleDict(into)), zeroed(nn.ModuleDict(out_of))

    def forward(
        self, maps: Float[Tensor, "B C H W"], more: Mapping[str, Float[Tensor, "B _ H W"]]
    ) -> tuple[Float[Tensor, "B D H W"], dict[str, Float[Tensor, "B _ H W"]]]:
        """Return the output at full size, and the further ones by the name of their part.

        Args:
            more: further inputs by the name of their part.
        """
        entered = self.enter(F.pixel_unshuffle(maps, 2))
        for name, layer in self.more_in.items():
            entered = entered + layer(F.pixel_unshuffle(more[name], 2))
        one = self.level1(entered)
        two = self.level2(self.down1(F.pixel_unshuffle(one, 2)))
        three = self.level3(self.down2(F.pixel_unshuffle(two, 2)))
        two = self.after2(two + F.pixel_shuffle(self.up2(three), 2))
        one = self.after1(one + F.pixel_shuffle(self.up1(two), 2))
        last = F.silu(one)
        found = {name: F.pixel_shuffle(layer(last), 2) for name, layer in self.more_out.items()}
        return F.pixel_shuffle(self.out(last), 2), found


class _Attention(nn.Module):
    """A layer of a transformer whose tokens are pixels; convolutions give them their positions."""

    def __init__(self, config: TransformerConfig) -> None:
        super().__init__()
        self.layer = TransformerBlock(config, causal=False)

    def forward(self, x: Float[Tensor, "B C h w"]) -> Float[Tensor, "B C h w"]:
        size = x.shape[-2:]
        return self.layer(x.flatten(2).transpose(1, 2)).transpose(1, 2).unflatten(2, size)
