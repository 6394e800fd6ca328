"""R2DM's efficient U-Net over the rays of a sensor: (noisy image, log SNR) → the noise in it.

Parameter names follow the reference's state dict, so that published weights load.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from lidargrit.core.configuration import Settings
from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Bounds, Count
from lidargrit.nn.blocks import Block, Network, zeroed
from lidargrit.nn.convolution import Convolution

_EPSILON = 1e-6  # of every norm, as in the reference
_LONGEST_PERIOD = 10_000  # of the sinusoids that tell the log SNR, as in the reference

_BLOCKS_AT_MOST = 1000  # over all levels; the published network has 12


@dataclass(frozen=True)
class UnetConfig(Settings):
    """Sizes of the network; the defaults are the published ones.

    Args:
        channels: number of channels of the finest level; the embedding of the noise level has four times as many.
        channel_multipliers: channels of each level over those of the finest, from fine to coarse; each further level
            halves both axes.
        residual_blocks: number of residual blocks of each level, on the way down and again on the way up.
        attention_heads: number of attention heads of the coarsest level, on both ways.
    """

    channels: Annotated[int, Bounds(4, multiple_of=2)] = 64
    channel_multipliers: tuple[Count, ...] = (1, 2, 4, 8)
    residual_blocks: tuple[Count, ...] = (3, 3, 3, 3)
    norm_groups: Count = 8
    attention_heads: Count = 8

    def __post_init__(self) -> None:
        super().__post_init__()
        if sum(self.residual_blocks) > _BLOCKS_AT_MOST:
            raise ConfigError(f"residual_blocks={self.residual_blocks}", f"{_BLOCKS_AT_MOST} at most", "lower them")
        if len(self.channel_multipliers) != len(self.residual_blocks):
            raise ConfigError(
                f"channel_multipliers={self.channel_multipliers}, residual_blocks={self.residual_blocks}",
                "as many residual_blocks as channel_multipliers",
                "correct them",
            )
        splits_heads = any(width % self.attention_heads for width in self.widths()[-2:])
        if self.channels % self.norm_groups or splits_heads:
            raise ConfigError(
                f"channels={self.channels} with {self.norm_groups} norm_groups, {self.attention_heads} attention_heads",
                "a multiple of both",
                "change one of them",
            )

    def widths(self) -> list[int]:
        """Return the channels of the input's convolution and of each level."""
        return [self.channels, *(self.channels * multiplier for multiplier in self.channel_multipliers)]


class EfficientUnet(Network):
    """Predicts noise in range images; azimuth wraps, and every pixel receives its ray's direction.

    Args:
        images: number of channels of the input and of the output.

    Source:
        Nakashima and Kurazume, R2DM, ICRA 2024, after Saharia et al., Imagen, 2022 (Efficient U-Net); layers and names
        as in kazuto1011/r2dm@1c5963d (MIT), whose published size has 31,099,650 parameters.
    """

    coords: Tensor

    def __init__(
        self, config: UnetConfig, images: int, elevation_rad: Float[Tensor, "H W"], azimuth_rad: Float[Tensor, "H W"]
    ) -> None:
        super().__init__()
        height, width = elevation_rad.shape
        self.levels = len(config.channel_multipliers)
        factor = 2 ** (self.levels - 1)
        if height % factor or width % factor:
            raise ConfigError(
                f"range images of {height}x{width}",
                f"both sizes divisible by {factor}, for {self.levels} levels",
                "use fewer channel_multipliers, or another number of columns",
            )
        # The angles are saved with the weights: published ones were trained on the edges of cells, not their centres.
        self.register_buffer("coords", torch.stack((elevation_rad, azimuth_rad))[None])
        self.octaves = (math.ceil(math.log2(height)), math.ceil(math.log2(width)))
        widths = config.widths()
        self.time_embedding = nn.Sequential(
            _Sinusoids(config.channels),
            nn.Linear(config.channels, 4 * config.channels),
            nn.SiLU(),
            nn.Linear(4 * config.channels, 4 * config.channels),
        )
        self.in_conv = Convolution(images + 2 * sum(self.octaves), widths[0], "wrap")
        for level, (above, below) in enumerate(pairwise(widths), 1):
            deepest = level == self.levels
            down = _Level(config, above, below, config.residual_blocks[level - 1], halve=level > 1, attend=deepest)
            joined = below if deepest else 2 * below
            up = _Level(config, joined, above, config.residual_blocks[level - 1], double=level > 1, attend=deepest)
            self.add_module(f"d_block{level}", down)
            self.add_module(f"u_block{level}", up)
        self.out_conv = zeroed(Convolution(widths[0], images, "wrap"))

    def forward(self, noisy: Float[Tensor, "B C H W"], log_snr: Float[Tensor, "B"]) -> Float[Tensor, "B C H W"]:
        """Return the predicted noise in images of these signal-to-noise ratios."""
        embedding = self.time_embedding(log_snr)
        x = self.in_conv(torch.cat((noisy, self.ray_features().expand(len(noisy), -1, -1, -1)), dim=1))
        passed: list[Tensor] = []
        for level in range(1, self.levels + 1):
            x = self.get_submodule(f"d_block{level}")(x, embedding)
            passed.append(x)
        x = passed.pop()
        for level in range(self.levels, 0, -1):
            x = self.get_submodule(f"u_block{level}")(x, embedding)
            if passed:
                x = torch.cat((x, passed.pop()), dim=1)
        return self.out_conv(x)

    def ray_features(self) -> Float[Tensor, "1 F H W"]:
        """Return sines, then cosines, of each ray's elevation and azimuth at frequencies 1, 2, 4, ..."""
        angles = [
            self.coords[:, axis : axis + 1] * 2**octave
            for axis, count in enumerate(self.octaves)
            for octave in range(count)
        ]
        phases = torch.cat(angles, dim=1)
        return torch.cat((phases.sin(), phases.cos()), dim=1)


class _Level(nn.Module):
    """Resolution and channels changed, residual blocks, and attention on the coarsest level."""

    def __init__(
        self,
        config: UnetConfig,
        inputs: int,
        outputs: int,
        blocks: int,
        halve: bool = False,
        double: bool = False,
        attend: bool = False,
    ) -> None:
        super().__init__()
        halved = [Convolution(inputs, outputs, "wrap"), _Halve()] if halve else []
        doubled = [_Double(), Convolution(outputs, outputs, "wrap")] if double else []
        self.downsample = nn.Sequential(*halved)
        first = outputs if halve else inputs
        self.residual_blocks = nn.ModuleList(
            _Residual(config, first if block == 0 else outputs, outputs) for block in range(blocks)
        )
        self.self_attn_block = _Attention(config, outputs) if attend else nn.Identity()
        self.upsample = nn.Sequential(*doubled)

    def forward(self, x: Tensor, embedding: Tensor) -> Tensor:
        x = self.downsample(x)
        for block in self.residual_blocks:
            x = block(x, embedding)
        return self.upsample(self.self_attn_block(x))


class _Residual(Block):
    def __init__(self, config: UnetConfig, inputs: int, outputs: int) -> None:
        super().__init__()
        self.norm1 = nn.GroupNorm(config.norm_groups, inputs, _EPSILON)
        self.conv1 = Convolution(inputs, outputs, "wrap")
        self.norm2 = _AdaptiveNorm(config, outputs)
        self.conv2 = zeroed(Convolution(outputs, outputs, "wrap"))
        self.skip = nn.Conv2d(inputs, outputs, 1) if inputs != outputs else nn.Identity()

    def forward(self, x: Tensor, embedding: Tensor) -> Tensor:
        h = self.conv1(F.silu(self.norm1(x)))
        h = self.conv2(F.silu(self.norm2(h, embedding)))
        return (self.skip(x) + h) / math.sqrt(2)  # keeps the variance of two independent summands


class _AdaptiveNorm(nn.Module):
    """A group norm whose scale and shift depend on the embedding."""

    def __init__(self, config: UnetConfig, channels: int) -> None:
        super().__init__()
        self.groups = config.norm_groups
        self.proj = nn.Sequential(nn.SiLU(), nn.Linear(4 * config.channels, 2 * channels))

    def forward(self, x: Tensor, embedding: Tensor) -> Tensor:
        scale, shift = self.proj(embedding)[..., None, None].chunk(2, dim=1)
        return F.group_norm(x, self.groups, eps=_EPSILON) * (1 + scale) + shift


class _Attention(nn.Module):
    def __init__(self, config: UnetConfig, channels: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(config.norm_groups, channels, _EPSILON)
        self.attn = _Projections(channels)
        self.heads = config.attention_heads

    def forward(self, x: Tensor) -> Tensor:
        pixels = self.norm(x).flatten(2).transpose(1, 2)  # (B, H W, C)
        joint = F.linear(pixels, self.attn.in_proj_weight, self.attn.in_proj_bias)
        q, k, v = joint.unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)  # each (B, heads, H W, d)
        seen = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)
        return (x + self.attn.out_proj(seen).transpose(1, 2).unflatten(2, x.shape[2:])) / math.sqrt(2)


class _Projections(nn.Module):
    """What torch's attention keeps, by its names."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.in_proj_weight = nn.Parameter(nn.init.xavier_uniform_(torch.empty(3 * channels, channels)))
        self.in_proj_bias = nn.Parameter(torch.zeros(3 * channels))
        self.out_proj = zeroed(nn.Linear(channels, channels))


class _Sinusoids(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.frequencies = channels // 2

    def forward(self, x: Tensor) -> Tensor:
        exponent = torch.arange(self.frequencies, device=x.device) / (self.frequencies - 1)
        phases = x[:, None] * _LONGEST_PERIOD**-exponent
        return torch.cat((phases.sin(), phases.cos()), dim=1)


class _Halve(nn.Module):
    """Weigh four neighbours by 1, 3, 3, 1 along each axis and keep every second; beyond the rows lie zeros."""

    def forward(self, x: Tensor) -> Tensor:
        even, odd = x.unflatten(-1, (-1, 2)).unbind(-1)
        x = (odd.roll(1, -1) + even.roll(-1, -1) + 3 * (even + odd)) / 8
        even, odd = x.unflatten(2, (-1, 2)).unbind(3)
        return (_down(odd) + _up(even) + 3 * (even + odd)) / 8


class _Double(nn.Module):
    """Put two pixels in the place of one, each three parts of it and one part of its nearer neighbour."""

    def forward(self, x: Tensor) -> Tensor:
        thrice = 3 * x
        x = torch.stack((thrice + x.roll(1, -1), thrice + x.roll(-1, -1)), dim=-1).flatten(-2) / 4
        thrice = 3 * x
        return torch.stack((thrice + _down(x), thrice + _up(x)), dim=3).flatten(2, 3) / 4


def _down(x: Tensor) -> Tensor:
    """Move every row one down; zeros come in."""
    return F.pad(x[:, :, :-1], (0, 0, 1, 0))


def _up(x: Tensor) -> Tensor:
    """Move every row one up; zeros come in."""
    return F.pad(x[:, :, 1:], (0, 0, 0, 1))
