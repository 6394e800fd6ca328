"""Tokens that need no learning: the nearest range of a cell, which parts of it are there, and which return nothing."""

import math
from dataclasses import dataclass
from itertools import product
from typing import Annotated

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Bounds, Count
from lidargrit.generation.pixel_decoder.range_mixture import RangeMixture
from lidargrit.generation.tokenizers import Tokenizer, TokenizerConfig
from lidargrit.nn.blocks import zeroed
from lidargrit.nn.codes import CodeFeatures
from lidargrit.nn.convolution import Convolution, Residual
from lidargrit.nn.flops import flops_of
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import Decoded, RangeImage, TokenGrid

_SAME_WITHIN = 0.07  # of the range: what is at the nearest range
_CODES_AT_MOST = 65_536
_SHIFTS = tuple((down, right) for down in (-1, 0, 1) for right in (-1, 0, 1))
_FINEST_M, _COARSEST_M = 0.01, 40.0
_COMPONENTS_TOLD = 4  # the likeliest, to a pixel decoder; each costs it as much as a neighbour's range
_FARTHER, _NEAREST, _DROPPED = _STATES = range(3)  # of a part of a cell
_TOLD = 3  # features of a pixel that are not learned: its part is nearest, its cell returns, its part is dropped
_WAVES, _BUMP_LEVELS = 16, 4  # over the levels, by which codes of near levels share weights: how many, how wide
_HEAD_START, _OF_PART = 4.0, 4.0  # of the logit of the own cell's range, and how much a pixel's part moves it


@dataclass(frozen=True)
class NearestRangeConfig(TokenizerConfig):
    """Sizes of the cells, of their codes, and of the network that decodes them.

    Args:
        cell_rows: number of rows of the cell of pixels that a token stands for.
        part_rows: number of parts into which the rows of a cell are divided; with 128 levels a cell has at most 5.
        part_columns: number of parts into which its columns are divided.
        levels: number of different ranges, evenly apart in the logarithm between the sensor's limits.
        width: number of channels of the decoder.
        blocks: number of residual blocks of the decoder.
        features: number of channels of each pixel, from which its range and its return are read.
    """

    cell_rows: Annotated[int, Bounds(1, 64)] = 8
    cell_columns: Annotated[int, Bounds(1, 64)] = 2
    part_rows: Count = 2
    part_columns: Count = 2
    levels: Annotated[int, Bounds(2)] = 128
    width: Annotated[int, Bounds(1, 4096)] = 64
    blocks: Annotated[int, Bounds(1, 100)] = 4
    features: Annotated[int, Bounds(1, 512)] = 16

    def __post_init__(self) -> None:
        super().__post_init__()
        for parts, whole in (("part_rows", "cell_rows"), ("part_columns", "cell_columns")):
            if getattr(self, whole) % getattr(self, parts):
                got = f"{parts}={getattr(self, parts)} of {whole}={getattr(self, whole)}"
                raise ConfigError(got, "parts of equal size", f"choose a divisor of {whole}")
        if self.num_codes > _CODES_AT_MOST:
            got = f"levels={self.levels} in {self.part_rows * self.part_columns} parts"
            raise ConfigError(got, f"at most {_CODES_AT_MOST} codes", "lower levels or parts")

    @property
    def num_patterns(self) -> int:
        """Number of ways in which the parts of a cell are at the nearest range, farther or dropped; one is nearest."""
        parts = self.part_rows * self.part_columns
        return len(_STATES) ** parts - (len(_STATES) - 1) ** parts

    @property
    def num_codes(self) -> int:
        """Number of codes: every level with every pattern of parts, and a cell without a return."""
        return 1 + self.levels * self.num_patterns


class NearestRangeTokenizer(Tokenizer[NearestRangeConfig]):
    """Tokens name the nearest range of their cell, so that a pole keeps its token whatever stands behind it.

    A token is 0 for a cell without a return. Any other is 1 + level * patterns + pattern: the level of the nearest
    range, and of each part of the cell whether it is dropped (fewer than half of its rays return), else nearest (at
    least half of its returns lie within 7 % of that range), else farther. The part of whose returns the largest share
    lies there is nearest in any case. A part of two rays that lost one by chance is not dropped: that would be noise.
    Nothing of that is learned. What is learned is to decode: each pixel has a distribution of its range whose
    components begin at the nearest ranges of its own and of the eight cells around, and the probability of its return.

    A mean error lets thin things go, since they are few pixels: a VQ-VAE after 800 scans keeps a third of the pixels of
    poles within 5 % of their range, these tokens keep nine tenths before anything is learned.
    """

    states: Tensor

    def __init__(self, config: NearestRangeConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        rows, columns = config.cell_rows, config.cell_columns
        if sensor.height % rows or sensor.width % columns:
            raise ConfigError(
                f"range images of {sensor.height}x{sensor.width} for cells of {rows}x{columns}",
                "cells that divide both sides",
                "choose other cells, or another number of columns",
            )
        self.num_codes = config.num_codes
        self.grid_size = (sensor.height // rows, sensor.width // columns)
        self.num_features, self.num_components = config.features + _TOLD, _COMPONENTS_TOLD
        self._low, self._high = math.log(sensor.range_min_m), math.log(sensor.range_max_m)
        components = len(_SHIFTS) + 1
        parts = config.part_rows * config.part_columns
        every = torch.tensor([states for states in product(_STATES, repeat=parts) if _NEAREST in states])
        self.register_buffer("states", every, persistent=False)  # of the parts in every pattern, in ascending order
        inputs = 2 + 2 * parts
        self.rows = nn.Parameter(torch.zeros(config.width, self.grid_size[0], 1))
        self.conv_in = Convolution(inputs, config.width, "wrap")
        self.blocks = nn.Sequential(*(Residual(config.width) for _ in range(config.blocks)))
        self.to_pixels = nn.Conv2d(config.width, config.features * rows * columns, 1)
        self.conv_out = zeroed(nn.Conv2d(self.num_features, 3 * components + 1, 1))
        with torch.no_grad():  # a pixel is at its own cell's range, the more if its part is, until more is learned
            bias, own = torch.zeros(3, components), _SHIFTS.index((0, 0))
            bias[0, own] = _HEAD_START
            self.conv_out.get_parameter("weight")[own, -_TOLD] = _OF_PART
            self.conv_out.get_parameter("bias").copy_(torch.cat((bias.flatten(), torch.tensor([2.0]))))

    def encode(self, images: RangeImage) -> TokenGrid:
        """Return the tokens (B, h, w) of a batch."""
        config = self.config
        range_m = self._cells(torch.where(images.return_mask, images.range_m, torch.inf))
        nearest = range_m.amin((-2, -1))
        returned = range_m < torch.inf
        close = returned & (range_m <= nearest[..., None, None] * (1 + _SAME_WITHIN))
        number_close, number = self._of_parts(close), self._of_parts(returned)
        share = number_close / number.clamp(min=1)
        # A part with the most of them is one in any case: of several that have equal shares, the one with more pixels.
        most = F.one_hot((share + 1e-3 * number_close).argmax(-1), share.shape[-1]) > 0
        rays_of_a_part = config.cell_rows * config.cell_columns // share.shape[-1]
        state = torch.where(share >= 0.5, _NEAREST, _FARTHER)
        state = torch.where(2 * number < rays_of_a_part, _DROPPED, state).masked_fill(most, _NEAREST)
        digits = len(_STATES) ** torch.arange(share.shape[-1] - 1, -1, -1, device=state.device)
        pattern = torch.searchsorted((self.states * digits).sum(-1), (state * digits).sum(-1))
        level = ((nearest.log() - self._low) / (self._high - self._low) * config.levels).floor()
        level = level.nan_to_num(posinf=0).clamp(0, config.levels - 1).long()
        tokens = torch.where(nearest < torch.inf, 1 + level * config.num_patterns + pattern, 0)
        return TokenGrid.unchecked(tokens, self.num_codes)

    def decode(self, tokens: TokenGrid) -> Decoded:
        """Return the likeliest range and the logit of a return of every pixel of a batch of tokens."""
        mixture, return_logits, features = self._decoded(tokens.tokens)
        logits, kept = mixture.logits.log_softmax(-1).topk(_COMPONENTS_TOLD)
        parts = logits, mixture.centres.gather(-1, kept), mixture.log_scales.gather(-1, kept)
        components = torch.stack([part.movedim(-1, 1) for part in parts], 1)
        return Decoded(mixture.mode(), return_logits, self.sensor, features=features, components=components)

    def code_features(self) -> CodeFeatures:
        """Return of every code waves and bumps over its level, the states of its parts, and emptiness; levels group."""
        config = self.config
        code = torch.arange(config.num_codes - 1)
        level, states = (code // config.num_patterns)[:, None].float(), self.states[code % config.num_patterns]
        waves = math.pi / config.levels * level * torch.arange(1, _WAVES + 1)
        bumps = torch.exp(-0.5 * ((level - torch.arange(0, config.levels, _BUMP_LEVELS)) / _BUMP_LEVELS) ** 2)
        of_codes = torch.cat((waves.sin(), waves.cos(), bumps, states == _NEAREST, states == _DROPPED), 1)
        return CodeFeatures(torch.block_diag(torch.ones(1, 1), of_codes), config.num_patterns)

    def decoding_flops(self) -> int:
        """Return the floating-point operations of decoding one scan."""
        cells = (1, self.config.width, *self.grid_size)
        pixels = (1, self.num_features, self.sensor.height, self.sensor.width)
        counted = flops_of(self.conv_in, (1, self.conv_in.in_channels, *self.grid_size))
        counted += flops_of(self.blocks, cells) + flops_of(self.to_pixels, cells) + flops_of(self.conv_out, pixels)
        return counted

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return the nats of a range and of a return, of which the loss is the sum, and errors of what is decoded."""
        images = example.images
        mask = images.return_mask
        mixture, return_logits, _ = self._decoded(self.encode(images).tokens)
        # Where nothing returned, any range within the limits stands in: its likelihood is not used.
        nats = -mixture.log_density(torch.where(mask, images.range_m, self.sensor.range_min_m)) * mask
        terms = {
            "range_nats": nats.sum() / mask.sum().clamp(min=1),
            "raydrop": F.binary_cross_entropy_with_logits(return_logits, mask.to(return_logits.dtype)),
        }
        with torch.no_grad():
            error_m = (mixture.mode() - images.range_m).abs()
            within = (error_m <= 0.05 * images.range_m) & mask
            errors = {
                "range_mae_m": (error_m * mask).sum() / mask.sum().clamp(min=1),
                "within_5_percent": within.sum() / mask.sum().clamp(min=1),
                "mask_accuracy": ((return_logits >= 0) == mask).float().mean(),
            }
        return {"loss": terms["range_nats"] + terms["raydrop"], **terms, **errors}

    def _cells(self, pixels: Float[Tensor, "B H W"]) -> Float[Tensor, "B h w p q"]:
        (rows, columns), (height, width) = (self.config.cell_rows, self.config.cell_columns), self.grid_size
        return pixels.unflatten(2, (width, columns)).unflatten(1, (height, rows)).movedim(2, 3)

    def _of_parts(self, chosen: Bool[Tensor, "B h w p q"]) -> Float[Tensor, "B h w parts"]:
        """Return the number of chosen pixels of each part of each cell."""
        parts = chosen.unflatten(-1, (self.config.part_columns, -1)).unflatten(-3, (self.config.part_rows, -1))
        return parts.sum((-3, -1)).flatten(-2).float()

    def _of_pixels(self, parts: Bool[Tensor, "B h w parts"]) -> Float[Tensor, "B H W"]:
        """Return for every pixel the value of its part of its cell; a single part is the cell."""
        config, single = self.config, parts.shape[-1] == 1
        down, right = (1, 1) if single else (config.part_rows, config.part_columns)
        maps = parts.unflatten(-1, (down, right)).permute(0, 1, 3, 2, 4).flatten(3, 4).flatten(1, 2).float()
        return maps.repeat_interleave(config.cell_rows // down, 1).repeat_interleave(config.cell_columns // right, 2)

    def _decoded(
        self, tokens: Int[Tensor, "B h w"]
    ) -> tuple[RangeMixture, Float[Tensor, "B H W"], Float[Tensor, "B F H W"]]:
        """Return the distribution of every range, the logits of the returns, and the features that they are read of."""
        config, returned = self.config, tokens > 0
        code = (tokens - 1).clamp(min=0)
        log_range = self._low + (code // config.num_patterns + 0.5) / config.levels * (self._high - self._low)
        states = self.states[code % config.num_patterns].masked_fill(~returned[..., None], _FARTHER)
        at_nearest, dropped = states == _NEAREST, states == _DROPPED
        scaled = torch.where(returned, 2 * (log_range - self._low) / (self._high - self._low) - 1, 0.0)
        maps = torch.stack((returned.float(), scaled, *torch.cat((at_nearest, dropped), -1).float().unbind(-1)), 1)
        x = F.silu(self.blocks(self.conv_in(maps) + self.rows))
        cells = self.to_pixels(x).unflatten(1, (config.features, config.cell_rows, config.cell_columns))
        features = F.silu(cells.permute(0, 1, 4, 2, 5, 3).flatten(4, 5).flatten(2, 3))
        told = torch.stack([self._of_pixels(one) for one in (at_nearest, returned[..., None], dropped)], 1) - 0.5
        features = torch.cat((features, told.to(features.dtype)), 1)
        output = self.conv_out(features).float()
        return self._mixture(output[:, :-1], torch.where(returned, log_range, torch.nan)), output[:, -1], features

    def _mixture(self, output: Float[Tensor, "B O H W"], log_range: Float[Tensor, "B h w"]) -> RangeMixture:
        """Return the mixture whose components begin at the nearest ranges of the cells around, and a free one."""
        logits, moved, scales = output.unflatten(1, (3, -1)).movedim(2, -1).unbind(1)
        middle = (self._low + self._high) / 2
        around = torch.stack([_shifted(log_range, *shift) for shift in _SHIFTS], -1)
        around = around.repeat_interleave(self.config.cell_rows, 1).repeat_interleave(self.config.cell_columns, 2)
        absent = around.isnan()
        around = torch.cat((around.nan_to_num(middle), torch.full_like(around[..., :1], middle)), -1)
        reach = torch.cat((torch.full_like(moved[0, 0, 0, 1:], 0.3), torch.full_like(moved[0, 0, 0, :1], 3.0)))
        limits_m = (self.sensor.range_min_m, self.sensor.range_max_m)
        v = (around + reach * moved).clamp(self._low, self._high).exp().log1p()
        hidden = F.pad(absent, (0, 1), value=False)
        logits = logits.masked_fill(hidden, -30.0)
        log_scales_m = (1.5 * scales - 1.0).clamp(math.log(_FINEST_M), math.log(_COARSEST_M))
        return RangeMixture(logits, v, log_scales_m - v, limits_m)


def _shifted(maps: Float[Tensor, "B h w"], down: int, right: int) -> Float[Tensor, "B h w"]:
    """Return for each cell the value of another; columns wrap around, rows beyond the image are NaN."""
    padded = F.pad(maps.roll(-right, 2), (0, 0, 1, 1), value=torch.nan)
    return padded[:, 1 + down : 1 + down + maps.shape[1]]
