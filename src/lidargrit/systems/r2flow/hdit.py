"""R2Flow's hourglass transformer (HDiT) over the rays of a sensor: (noisy image, time) → its velocity.

Parameter names follow the reference's state dict, so that published weights load.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from lidargrit.core.configuration import Settings
from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Bounds, Count
from lidargrit.nn.blocks import Block, Network, zeroed

_ROWS = 3  # of the window, as R2Flow has it
_REACH = 4  # columns of the window on each side of the token
_COLUMNS_AT_ONCE = 8  # more have fewer copies of keys, and more products that come to nothing


def neighbourhood_attention(
    q: Float[Tensor, "B heads h w d"], k: Float[Tensor, "B heads h w d"], v: Float[Tensor, "B heads h w d"]
) -> Float[Tensor, "B heads h w d"]:
    """Mix the values of 3x9 tokens around each token, by the softmax of the products of queries and keys.

    Columns wrap. In the first and the last row the window lies inwards, so that it always has 3 rows, or all where
    there are fewer. On a grid of fewer than 9 columns a token counts once for every time that the window covers it.

    Source:
        Hassani et al., Neighborhood Attention Transformer, CVPR 2023, with the window of Nakashima et al., R2Flow, ICRA
        2025.
    """
    columns = q.shape[3]
    together = next(size for size in range(_COLUMNS_AT_ONCE, 0, -1) if columns % size == 0)
    keys, values = (_windows(each, together) for each in (k, v))  # each (B, heads, h, w / together, keys, d)
    logits = (q.unflatten(3, (-1, together)) @ keys.transpose(-1, -2)).float()  # (B, heads, h, n, together, keys)
    column = torch.arange(together, device=q.device)[:, None]
    offset = torch.arange(together + 2 * _REACH, device=q.device) - column
    seen = ((offset >= 0) & (offset <= 2 * _REACH)).repeat(1, min(_ROWS, q.shape[2]))
    weights = logits.masked_fill(~seen, -torch.inf).softmax(-1).type_as(values)
    return (weights @ values).flatten(3, 4)


def _windows(x: Float[Tensor, "B heads h w d"], together: int) -> Float[Tensor, "B heads h n keys d"]:
    """Return what each group of neighbouring columns may see: rows one after the other, and the columns of each."""
    # By slices and shifts, since the gradient of Tensor.unfold takes five times as long.
    width, height, rows = together + 2 * _REACH, x.shape[2], min(_ROWS, x.shape[2])
    before, after, inner = (rows - 1) // 2, rows // 2, height - rows + 1
    parts = []
    for each in (x[:, :, row : row + inner] for row in range(rows)):
        shifted = torch.cat((*[each[:, :, :1]] * before, each, *[each[:, :, -1:]] * after), dim=2)
        for start in range(0, width, together):
            groups = shifted.roll(_REACH - start, dims=3).unflatten(3, (-1, together))
            parts.append(groups[..., : width - start, :])
    return torch.cat(parts, dim=4)


_EPSILON = 1e-6  # of every norm, as in the reference
_COLUMNS_PER_TOKEN = 4
_WIDENING = 3  # of the layers between two others, in every feed-forward
_BLOCKS_AT_MOST = 1000  # over all levels; the published network has 21 on both ways


@dataclass(frozen=True)
class HditConfig(Settings):
    """Sizes of the network; the defaults are the published ones.

    Args:
        channels: length of the vector that stands for a token of the finest level; each further level doubles it.
        time_channels: length of the vector that stands for the time.
        depths: number of blocks in each level, the finest first. All levels but the last have as many on the way down
            as on the way up, and each further level halves the rows and the columns of tokens.
        heads: number of attention heads in each level.
    """

    channels: Annotated[int, Bounds(4)] = 128
    time_channels: Annotated[int, Bounds(2, multiple_of=2)] = 256
    depths: Annotated[tuple[Count, ...], Bounds(2)] = (3, 3, 3, 3)
    heads: tuple[Count, ...] = (2, 4, 8, 16)

    def __post_init__(self) -> None:
        super().__post_init__()
        if sum(self.depths) > _BLOCKS_AT_MOST:
            raise ConfigError(f"depths={self.depths}", f"{_BLOCKS_AT_MOST} blocks at most", "lower them")
        if len(self.depths) != len(self.heads):
            raise ConfigError(f"depths={self.depths}, heads={self.heads}", "one of each a level", "correct them")
        each = zip(self.widths(), self.heads, strict=True)
        if any(width % (4 * heads) for width, heads in each):
            raise ConfigError(
                f"channels={self.channels}, heads={self.heads}",
                "in every level a multiple of 4 channels for each head",
                "change one of them",
            )

    def widths(self) -> list[int]:
        """Return the number of channels of each level."""
        return [self.channels * 2**level for level in range(len(self.depths))]


class Hdit(Network):
    """Predicts the velocity of range images; azimuth wraps, and attention depends on the rays of the tokens.

    Source:
        Crowson et al., Hourglass Diffusion Transformer, ICML 2024, as changed in Nakashima et al., R2Flow, ICRA 2025
        (kazuto1011/r2flow@3f5afeb, MIT), whose published size has 80,908,420 parameters.
    """

    coords: Tensor

    def __init__(
        self, config: HditConfig, images: int, elevation_rad: Float[Tensor, "H W"], azimuth_rad: Float[Tensor, "H W"]
    ) -> None:
        super().__init__()
        height, width = elevation_rad.shape
        self.images, self.coarsest = images, len(config.depths) - 1
        rows, columns = 2**self.coarsest, _COLUMNS_PER_TOKEN * 2**self.coarsest
        if height % rows or width % columns:
            raise ConfigError(
                f"range images of {height}x{width}",
                f"rows divisible by {rows} and columns by {columns}, for {self.coarsest + 1} levels",
                "use fewer depths, or another number of columns",
            )
        tokens, widths = (height, width // _COLUMNS_PER_TOKEN), config.widths()
        # The angles are saved with the weights: published ones were trained on the edges of cells, not their centres.
        self.register_buffer("coords", torch.stack((elevation_rad, azimuth_rad))[None])
        patch = (1, _COLUMNS_PER_TOKEN)
        self.tokenizer = nn.Sequential(nn.Conv2d(images, widths[0], patch, patch, bias=False))
        self.spatial_pe = _Positions(tokens, widths[0])
        n = config.time_channels
        parts = _Frequencies(n), nn.Sequential(_Rms(n), _TimeFeedForward(n), _TimeFeedForward(n), _Rms(n))
        self.timestep_pe = nn.Sequential(*parts)
        self.down_levels, self.up_levels = nn.ModuleDict(), nn.ModuleDict()
        for level in range(self.coarsest):
            self.down_levels[f"level_{level}"] = _blocks(config, level, tokens)
            self.down_levels[f"merge_{level}"] = nn.Sequential(
                _Merge(), nn.Linear(4 * widths[level], widths[level + 1], bias=False)
            )
        self.mid_levels = _blocks(config, self.coarsest, tokens)
        for level in reversed(range(self.coarsest)):
            self.up_levels[f"expand_{level}"] = _Expand(widths[level])
            self.up_levels[f"level_{level}"] = _blocks(config, level, tokens)
        self.detokenizer = nn.Sequential(_Rms(widths[0]), _zero_linear(widths[0], images * _COLUMNS_PER_TOKEN))

    def forward(self, noisy: Float[Tensor, "B C H W"], time: Float[Tensor, "B"]) -> Float[Tensor, "B C H W"]:
        """Return the velocity of images at these times, from 0 for noise to 1 for clean images."""
        embedding = self.timestep_pe(time)
        x = self.spatial_pe(self.tokenizer(noisy).permute(0, 2, 3, 1))  # (B, h, w, channels)
        angles, passed = [F.avg_pool2d(self.coords, (1, _COLUMNS_PER_TOKEN))], []
        for level in range(self.coarsest):
            x = _through(self.down_levels[f"level_{level}"], x, embedding, angles[level])
            passed.append(x)
            x = self.down_levels[f"merge_{level}"](x)
            angles.append(F.avg_pool2d(angles[level], 2))
        x = _through(self.mid_levels, x, embedding, angles[-1])
        for level in reversed(range(self.coarsest)):
            x = self.up_levels[f"expand_{level}"](x, passed[level])
            x = _through(self.up_levels[f"level_{level}"], x, embedding, angles[level])
        pixels = self.detokenizer(x).unflatten(-1, (_COLUMNS_PER_TOKEN, -1))  # (B, h, w, columns, C)
        return pixels.flatten(2, 3).permute(0, 3, 1, 2)


class _Positions(nn.Module):
    """A learned vector for every token of the finest level."""

    def __init__(self, tokens: tuple[int, int], channels: int) -> None:
        super().__init__()
        self.embedding = nn.Parameter(torch.empty(1, *tokens, channels))
        nn.init.trunc_normal_(self.embedding, std=0.02)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.embedding


class _Frequencies(nn.Module):
    """Time as cosines and sines of random frequencies that stay as they are."""

    freqs: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.register_buffer("freqs", torch.randn(channels // 2))
        self.linear = nn.Linear(channels, channels, bias=False)

    def forward(self, time: Tensor) -> Tensor:
        phases = 2 * math.pi * time[:, None] * self.freqs
        return self.linear(torch.cat((phases.cos(), phases.sin()), dim=-1))


def _blocks(config: HditConfig, level: int, tokens: tuple[int, int]) -> nn.ModuleList:
    """Return the blocks of one level, on one way.

    Args:
        level: index of the level, 0 for the finest.
        tokens: number of rows and columns of tokens in the finest level.
    """
    sizes = config.widths()[level], config.heads[level], config.time_channels
    highest = [max((number // 2) >> level, 1) for number in tokens]
    coarsest = level == len(config.depths) - 1
    return nn.ModuleList(_Block(*sizes, *highest, everywhere=coarsest) for _ in range(config.depths[level]))


def _through(blocks: nn.Module, x: Tensor, embedding: Tensor, angles_rad: Tensor) -> Tensor:
    for block in blocks.children():
        x = block(x, embedding, angles_rad)
    return x


class _Block(Block):
    """Attention, then a feed-forward, both under a norm that depends on the time."""

    def __init__(
        self, channels: int, heads: int, time_channels: int, highest_h: int, highest_w: int, everywhere: bool
    ) -> None:
        super().__init__()
        self.residual_attn = _Attention(channels, heads, time_channels, highest_h, highest_w, everywhere)
        self.residual_ffn = _FeedForward(channels, time_channels)

    def forward(self, x: Tensor, embedding: Tensor, angles_rad: Tensor) -> Tensor:
        return self.residual_ffn(self.residual_attn(x, embedding, angles_rad), embedding)


class _Attention(nn.Module):
    """Attention by the cosine of queries and keys, of every token to all others or to its neighbours."""

    def __init__(
        self, channels: int, heads: int, time_channels: int, highest_h: int, highest_w: int, everywhere: bool
    ) -> None:
        super().__init__()
        self.heads, self.everywhere = heads, everywhere
        self.norm = _AdaptiveRms(channels, time_channels)
        self.qkv_proj = nn.Linear(channels, 3 * channels, bias=False)
        self.scale = nn.Parameter(torch.full((heads, 1), math.log(10)))
        self.rope = _Rotary(heads, channels // heads, highest_h, highest_w)
        self.out_proj = _zero_linear(channels, channels)

    def forward(self, x: Tensor, embedding: Tensor, angles_rad: Tensor) -> Tensor:
        joint = self.qkv_proj(self.norm(x, embedding)).unflatten(-1, (3, self.heads, -1))
        joint = joint.permute(3, 0, 4, 1, 2, 5)  # (3, B, heads, h, w, d)
        sharpness = self.scale.clamp(max=math.log(100)).exp().sqrt()[:, None, None]
        v = joint[2]
        q, k = _turned(_of_length(joint[:2], sharpness), self.rope(angles_rad)).type_as(v)
        if self.everywhere:
            mixed = F.scaled_dot_product_attention(q.flatten(2, 3), k.flatten(2, 3), v.flatten(2, 3), scale=1.0)
            mixed = mixed.unflatten(2, q.shape[2:4])
        else:
            mixed = neighbourhood_attention(q, k, v)
        return x + self.out_proj(mixed.permute(0, 2, 3, 1, 4).flatten(-2))


class _Rotary(nn.Module):
    """Angles by which heads turn their queries and keys: whole multiples of elevation and azimuth."""

    freqs_h: Tensor
    freqs_w: Tensor

    def __init__(self, heads: int, channels_per_head: int, highest_h: int, highest_w: int) -> None:
        super().__init__()
        each = channels_per_head // 4
        for name, highest in (("freqs_h", highest_h), ("freqs_w", highest_w)):
            # In whole numbers, azimuth closes the circle.
            multiples = torch.linspace(0, math.log(highest), heads * each).exp().round()
            self.register_buffer(name, multiples.unflatten(0, (each, heads)).T.contiguous())

    def forward(self, angles_rad: Float[Tensor, "1 2 h w"]) -> Float[Tensor, "heads h w d"]:
        """Return the angles of half of the channels, in radians."""
        elevation, azimuth = angles_rad[0, :, None, :, :, None]  # (1, h, w, 1) each
        return torch.cat((elevation * self.freqs_h[:, None, None], azimuth * self.freqs_w[:, None, None]), dim=-1)


def _turned(x: Tensor, turn_rad: Tensor) -> Tensor:
    """Rotate each channel of the first half of a head together with the corresponding one of the second half."""
    (first, second), cos, sin = x.chunk(2, dim=-1), turn_rad.cos(), turn_rad.sin()
    return torch.cat((first * cos - second * sin, second * cos + first * sin), dim=-1)


def _of_length(x: Tensor, length: Tensor) -> Tensor:
    x = x.float()
    return x * (length * torch.rsqrt(x.square().sum(-1, keepdim=True) + _EPSILON))


class _FeedForward(nn.Module):
    def __init__(self, channels: int, time_channels: int) -> None:
        super().__init__()
        self.adarms = _AdaptiveRms(channels, time_channels)
        self.gegelu = _Geglu(channels)
        self.linear = _zero_linear(_WIDENING * channels, channels)

    def forward(self, x: Tensor, embedding: Tensor) -> Tensor:
        return x + self.linear(self.gegelu(self.adarms(x, embedding)))


class _TimeFeedForward(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = _Rms(channels)
        self.gegelu = _Geglu(channels)
        self.linear = _zero_linear(_WIDENING * channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.linear(self.gegelu(self.norm(x)))


class _Geglu(nn.Linear):
    def __init__(self, channels: int) -> None:
        super().__init__(channels, 2 * _WIDENING * channels, bias=False)

    def forward(self, input: Tensor) -> Tensor:
        passed, gate = super().forward(input).chunk(2, dim=-1)
        return passed * F.gelu(gate)


class _Rms(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        return F.rms_norm(x.float(), self.scale.shape, self.scale, _EPSILON)


class _AdaptiveRms(nn.Module):
    """A norm whose scale depends on the time."""

    def __init__(self, channels: int, time_channels: int) -> None:
        super().__init__()
        self.proj = nn.Sequential(_zero_linear(time_channels, channels))

    def forward(self, x: Tensor, embedding: Tensor) -> Tensor:
        scale = 1 + self.proj(embedding)[:, None, None]
        return F.rms_norm(x.float(), x.shape[-1:], eps=_EPSILON) * scale


class _Merge(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return x.unflatten(2, (-1, 2)).unflatten(1, (-1, 2)).transpose(2, 3).flatten(3)


class _Expand(nn.Module):
    """Make 2x2 tokens of one, and mix them with those that were merged on the way down, by a learned share."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.linear = nn.Linear(2 * channels, 4 * channels, bias=False)
        self.alpha = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Tensor, passed: Tensor) -> Tensor:
        split = self.linear(x).unflatten(-1, (2, 2, -1))  # (B, h, w, 2, 2, channels)
        finer = split.transpose(2, 3).flatten(3, 4).flatten(1, 2)
        return torch.lerp(passed.float(), finer.float(), self.alpha.sigmoid())


def _zero_linear(inputs: int, outputs: int) -> nn.Linear:
    """Return a linear layer of zeros, so that a new block adds nothing."""
    return zeroed(nn.Linear(inputs, outputs, bias=False))
