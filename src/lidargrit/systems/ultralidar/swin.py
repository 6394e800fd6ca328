"""Transformer blocks that attend within shifted windows of a grid of tokens: (B, T, C) → (B, T, C).

Names of weights are those of timm 0.5.4, so that published weights load.

Source:
    Liu et al., Swin Transformer, ICCV 2021, section 3.2.
"""

from dataclasses import dataclass
from typing import Annotated

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from lidargrit.core.configuration import Settings
from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Bounds, Count
from lidargrit.nn.blocks import Block

_BLOCKS_AT_MOST = 1000
_WINDOW = 8  # tokens along each side
_OTHER_REGION = -100.0  # added to the logits of tokens that are neighbours only because the grid was rolled


@dataclass(frozen=True)
class SwinConfig(Settings):
    """Sizes of a stack of blocks; the defaults are those of UltraLiDAR's encoder and decoder.

    Args:
        width: length of the vector that stands for a token.
        heads: number of attention heads in each block.
        blocks: number of blocks; the windows of every second block are shifted by half a window.
    """

    width: Annotated[int, Bounds(4, multiple_of=4)] = 512
    heads: Count = 16
    blocks: Annotated[int, Bounds(1, _BLOCKS_AT_MOST)] = 12

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.width % self.heads:
            raise ConfigError(
                f"heads={self.heads}, width={self.width}",
                "a width that is a multiple of the heads",
                "change the width or the heads",
            )


def swin_blocks(config: SwinConfig, grid: tuple[int, int]) -> nn.Sequential:
    """Return the blocks over a grid of tokens (rows, columns)."""
    window = min(_WINDOW, *grid)
    if grid[0] % window or grid[1] % window:
        raise ConfigError(f"{grid[0]}x{grid[1]} tokens", f"multiples of {window} both", "change the cells or the patch")
    shift = window // 2 if min(grid) > window else 0
    return nn.Sequential(
        *(_SwinBlock(config, grid, window, shift if number % 2 else 0) for number in range(config.blocks))
    )


def sine_cosine_positions(grid: tuple[int, int], width: int) -> Float[Tensor, "1 T C"]:
    """Return fixed vectors for the tokens of a grid: sines and cosines of the column, then of the row.

    Source:
        He et al., Masked Autoencoders, CVPR 2022, whose program has this order.
    """
    frequency = 10000 ** -(torch.arange(width // 4, dtype=torch.float64) / (width // 4))
    row, column = (torch.arange(count, dtype=torch.float64)[:, None] * frequency for count in grid)
    row, column = (torch.cat((of.sin(), of.cos()), dim=1) for of in (row, column))
    rows, columns = row[:, None].expand(-1, grid[1], -1), column[None].expand(grid[0], -1, -1)
    return torch.cat((columns, rows), dim=-1).flatten(0, 1).float()[None]


def initialise_linear(module: nn.Module) -> None:
    """Fill the weights of a linear layer as UltraLiDAR's program does: Xavier, uniform, and no bias."""
    if isinstance(module, nn.Linear):
        nn.init.xavier_uniform_(module.weight)
        if module.bias is not None:
            nn.init.zeros_(module.bias)


class _SwinBlock(Block):
    def __init__(self, config: SwinConfig, grid: tuple[int, int], window: int, shift: int) -> None:
        super().__init__()
        self._grid, self._window, self._shift = grid, window, shift
        self.norm1, self.norm2 = nn.LayerNorm(config.width), nn.LayerNorm(config.width)
        self.attn = _WindowAttention(config, window)
        self.mlp = _Perceptron(config.width)
        self.regions: Tensor | None
        self.register_buffer("regions", _regions(grid, window, shift) if shift else None, persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        tokens = self.norm1(x).unflatten(1, self._grid)
        if self._shift:
            tokens = tokens.roll((-self._shift, -self._shift), dims=(1, 2))
        mixed = _merged(self.attn(_split(tokens, self._window), self.regions), self._grid, self._window)
        if self._shift:
            mixed = mixed.roll((self._shift, self._shift), dims=(1, 2))
        x = x + mixed.flatten(1, 2)
        return x + self.mlp(self.norm2(x))


class _WindowAttention(nn.Module):
    relative_position_index: Tensor

    def __init__(self, config: SwinConfig, window: int) -> None:
        super().__init__()
        self._heads = config.heads
        self.relative_position_bias_table = nn.Parameter(torch.zeros((2 * window - 1) ** 2, config.heads))
        nn.init.trunc_normal_(self.relative_position_bias_table, std=0.02)
        self.register_buffer("relative_position_index", _offsets(window), persistent=False)
        self.qkv = nn.Linear(config.width, 3 * config.width)
        self.proj = nn.Linear(config.width, config.width)

    def forward(self, x: Float[Tensor, "B windows t C"], regions: Tensor | None) -> Tensor:
        qkv = self.qkv(x).unflatten(-1, (3, self._heads, -1)).movedim(-3, 0).transpose(-2, -3)
        q, k, v = qkv.unbind()  # (B, windows, heads, t, d)
        bias = self.relative_position_bias_table[self.relative_position_index].movedim(-1, 0)  # (heads, t, t)
        logits = (q * q.shape[-1] ** -0.5) @ k.transpose(-1, -2) + bias
        if regions is not None:
            logits = logits + regions[:, None]
        return self.proj((logits.softmax(dim=-1) @ v).transpose(-2, -3).flatten(-2))


class _Perceptron(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(F.gelu(self.fc1(x)))


def _split(x: Float[Tensor, "B h w C"], window: int) -> Float[Tensor, "B windows t C"]:
    cut = x.unflatten(2, (-1, window)).unflatten(1, (-1, window))  # (B, rows, window, columns, window, C)
    return cut.transpose(2, 3).flatten(3, 4).flatten(1, 2)


def _merged(x: Float[Tensor, "B windows t C"], grid: tuple[int, int], window: int) -> Float[Tensor, "B h w C"]:
    cut = x.unflatten(2, (window, window)).unflatten(1, (grid[0] // window, grid[1] // window))
    return cut.transpose(2, 3).flatten(3, 4).flatten(1, 2)


def _offsets(window: int) -> Tensor:
    """Return the index of the bias for every pair of tokens of a window: by the row offset, then the column offset."""
    row = torch.arange(window).repeat_interleave(window)
    column = torch.arange(window).repeat(window)
    row, column = (of[:, None] - of[None] + window - 1 for of in (row, column))
    return row * (2 * window - 1) + column


def _regions(grid: tuple[int, int], window: int, shift: int) -> Float[Tensor, "windows t t"]:
    """Return what keeps tokens of a window apart that were not neighbours before the grid was rolled."""
    parts = []
    for count in grid:
        index = torch.arange(count)
        parts.append((index >= count - window).long() + (index >= count - shift).long())
    part = (3 * parts[0][:, None] + parts[1][None]).float()[None, :, :, None]
    of_window = _split(part, window)[0, :, :, 0]
    return torch.where(of_window[:, :, None] == of_window[:, None, :], 0.0, _OTHER_REGION)
