"""The U-Net of latent diffusion over latents of range images: (noisy latents, time step) → the noise in them.

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
from lidargrit.core.typed_values import Bounds, Count, NotNegative
from lidargrit.nn.blocks import Block, Network, zeroed
from lidargrit.nn.convolution import Convolution, wrapped

_LONGEST_PERIOD = 10_000  # of the waves that tell the time step, as in the reference
_BLOCKS_AT_MOST = 100  # residual blocks of a level; the published network has 2


@dataclass(frozen=True)
class LatentUnetConfig(Settings):
    """Sizes of the network; the defaults are the published ones.

    Args:
        channels: number of channels of the finest level, a multiple of ``norm_groups``; the embedding of the time step
            has four times as many.
        channel_multipliers: channels of each level over those of the finest, from fine to coarse; each further level
            halves rows and columns.
        residual_blocks: number of residual blocks of each level on the way down; on the way up there is one more.
        attention_levels: numbers of the levels with attention after each block, the finest level being 0. The middle of
            the network has attention besides.
        head_channels: number of channels of an attention head.
        norm_groups: number of groups of every group norm. A group of one channel loses its mean over the image, and a
            network of such groups cannot see whether latents are too high or too low as a whole.
    """

    channels: Annotated[int, Bounds(2, multiple_of=2)] = 256
    channel_multipliers: Annotated[tuple[Count, ...], Bounds(1, 16)] = (1, 2, 4)
    residual_blocks: Annotated[int, Bounds(1, _BLOCKS_AT_MOST)] = 2
    attention_levels: tuple[NotNegative, ...] = (0, 1, 2)
    head_channels: Count = 32
    norm_groups: Count = 32

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.channels % self.norm_groups:
            raise ConfigError(
                f"channels={self.channels} in norm_groups={self.norm_groups}",
                "a number of channels that is a multiple of the groups",
                "change one of them",
            )
        multipliers = self.channel_multipliers
        with_heads = {*self.attention_levels, len(multipliers) - 1}
        if max(with_heads) >= len(multipliers):
            got = f"attention_levels={self.attention_levels}"
            raise ConfigError(got, f"numbers from 0 to {len(multipliers) - 1}", "leave the others out")
        if any(self.channels * multipliers[of] % self.head_channels for of in with_heads):
            got = f"head_channels={self.head_channels}"
            raise ConfigError(got, "a divisor of the channels of every level with attention", "e.g. head_channels=16")


class LatentUnet(Network):
    """Predicts the noise in latents; azimuth wraps.

    Args:
        latent_channels: number of channels of the input and of the output.
        grid_size: rows and columns of the latents.

    Source:
        Rombach et al., Latent Diffusion, CVPR 2022, after Dhariwal and Nichol, 2021; layers and names as in
        hancyran/LiDAR-Diffusion@8416ddb (MIT), whose published size has 257,751,560 parameters.
    """

    def __init__(self, config: LatentUnetConfig, latent_channels: int, grid_size: tuple[int, int]) -> None:
        super().__init__()
        levels = len(config.channel_multipliers)
        factor = 2 ** (levels - 1)
        if grid_size[0] % factor or grid_size[1] % factor:
            raise ConfigError(
                f"latents of {grid_size[0]}x{grid_size[1]}",
                f"both sizes divisible by {factor}, for {levels} levels",
                "use fewer channel_multipliers, or another number of columns",
            )
        self.waves, embedding = config.channels, 4 * config.channels
        self.time_embed = nn.Sequential(
            nn.Linear(config.channels, embedding), nn.SiLU(), nn.Linear(embedding, embedding)
        )
        width = config.channels
        self.input_blocks = nn.ModuleList([_Steps([Convolution(latent_channels, width, "wrap")])])
        passed = [width]
        for level, multiplier in enumerate(config.channel_multipliers):
            for _ in range(config.residual_blocks):
                self.input_blocks.append(_steps(config, width, config.channels * multiplier, level))
                width = config.channels * multiplier
                passed.append(width)
            if level < levels - 1:
                self.input_blocks.append(_Steps([_Halve(width)]))
                passed.append(width)
        self.middle_block = _Steps(
            [_Residual(width, width, config), _Attention(width, config), _Residual(width, width, config)]
        )
        self.output_blocks = nn.ModuleList()
        for level, multiplier in reversed([*enumerate(config.channel_multipliers)]):
            for block in range(config.residual_blocks + 1):
                steps = _steps(config, width + passed.pop(), config.channels * multiplier, level)
                width = config.channels * multiplier
                if level and block == config.residual_blocks:
                    steps.append(_Double(width))
                self.output_blocks.append(steps)
        self.out = nn.Sequential(
            nn.GroupNorm(config.norm_groups, width), nn.SiLU(), zeroed(Convolution(width, latent_channels, "wrap"))
        )

    def forward(self, noisy: Float[Tensor, "B D h w"], step: Float[Tensor, "B"]) -> Float[Tensor, "B D h w"]:
        """Return the predicted noise in latents of these time steps, whole numbers from 0."""
        embedding = self.time_embed(_waves(step, self.waves))
        x, passed = noisy, []
        for block in self.input_blocks:
            x = block(x, embedding)
            passed.append(x)
        x = self.middle_block(x, embedding)
        for block in self.output_blocks:
            x = block(torch.cat((x, passed.pop()), dim=1), embedding)
        return self.out(x)


class _Steps(nn.ModuleList):
    """Layers one after the other, of which the residual blocks also get the embedding of the time step."""

    def forward(self, x: Float[Tensor, "B C h w"], embedding: Float[Tensor, "B E"]) -> Float[Tensor, "B D i j"]:
        for layer in self:
            x = layer(x, embedding) if isinstance(layer, _Residual) else layer(x)
        return x


def _steps(config: LatentUnetConfig, inputs: int, outputs: int, level: int) -> _Steps:
    """Return a residual block of a level, with attention after it if the level has it."""
    attention = [_Attention(outputs, config)] if level in config.attention_levels else []
    return _Steps([_Residual(inputs, outputs, config), *attention])


class _Residual(Block):
    """Norm, swish, convolution, twice, with the embedding added between; then the input is added."""

    def __init__(self, inputs: int, outputs: int, config: LatentUnetConfig) -> None:
        super().__init__()
        groups, embedding = config.norm_groups, 4 * config.channels
        self.in_layers = nn.Sequential(nn.GroupNorm(groups, inputs), nn.SiLU(), Convolution(inputs, outputs, "wrap"))
        self.emb_layers = nn.Sequential(nn.SiLU(), nn.Linear(embedding, outputs))
        # The program has dropout of 0 before the last convolution, which counts in the names of weights.
        last = zeroed(Convolution(outputs, outputs, "wrap"))
        self.out_layers = nn.Sequential(nn.GroupNorm(groups, outputs), nn.SiLU(), nn.Identity(), last)
        self.skip_connection = nn.Conv2d(inputs, outputs, 1) if inputs != outputs else nn.Identity()

    def forward(self, x: Tensor, embedding: Tensor) -> Tensor:
        h = self.in_layers(x) + self.emb_layers(embedding)[..., None, None]
        return self.skip_connection(x) + self.out_layers(h)


class _Attention(Block):
    def __init__(self, channels: int, config: LatentUnetConfig) -> None:
        super().__init__()
        self.heads = channels // config.head_channels
        self.norm = nn.GroupNorm(config.norm_groups, channels)
        self.qkv = nn.Conv1d(channels, 3 * channels, 1)
        self.proj_out = zeroed(nn.Conv1d(channels, channels, 1))

    def forward(self, x: Tensor) -> Tensor:
        joint = self.qkv(self.norm(x).flatten(2))  # (B, heads * 3 * d, h w): each head has its own q, k and v in a row
        q, k, v = joint.unflatten(1, (self.heads, 3, -1)).transpose(-2, -1).unbind(2)  # each (B, heads, h w, d)
        seen = F.scaled_dot_product_attention(q, k, v).transpose(-2, -1).flatten(1, 2)
        return x + self.proj_out(seen).unflatten(2, x.shape[2:])


class _Halve(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.op = nn.Conv2d(channels, channels, 3, stride=2, padding=(1, 0))

    def forward(self, x: Tensor) -> Tensor:
        return self.op(wrapped(x))


class _Double(nn.Module):
    """Double rows and columns by repeating latents, then convolve."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = Convolution(channels, channels, "wrap")

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(F.interpolate(x, scale_factor=2.0, mode="nearest"))


def _waves(step: Float[Tensor, "B"], channels: int) -> Float[Tensor, "B C"]:
    """Return cosines, then sines, of the time step at falling frequencies."""
    half = channels // 2
    exponents = torch.arange(half, device=step.device, dtype=torch.float32) / half
    phases = step[:, None] * torch.exp(-math.log(_LONGEST_PERIOD) * exponents)
    return torch.cat((phases.cos(), phases.sin()), dim=1)
