"""The paper's first stage, a VQ-VAE whose decoder gives a clean range and, apart from it, the raydrop."""

import copy
import math
from collections import OrderedDict
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Bounds, Count, NotNegative, ShareBelow1, Weight
from lidargrit.generation.reflectance import required_reflectance
from lidargrit.generation.tokenizers import TokenizerConfig
from lidargrit.generation.tokenizers._convolutional import (
    CodeDim,
    ConvolutionalDecoder,
    ConvolutionalEncoder,
    ConvolutionalTokenizer,
    Level,
    NumCodes,
    ResidualBlocks,
)
from lidargrit.nn.codebook import CodebookLoss
from lidargrit.nn.convolution import (
    Convolution,
    Downsample,
    FoldedUpsample,
    Padding,
    ResidualBlock,
    Upsample,
    group_norm,
)
from lidargrit.nn.flops import flops_of
from lidargrit.nn.precision import Precision, at_least_32_bits, dtype_of
from lidargrit.scans.example import Example
from lidargrit.scans.projection import EncodingName, RangeEncoding
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import Decoded, RangeImage, TokenGrid

_LEVELS_AT_MOST = 16  # each further one halves both axes; after these 65,536 columns are two
_NO_RETURN_BELOW = -0.9  # without a raydrop head, an encoded range below this is read as no return (the program's rule)

_SETTING = "model.tokenizer.reflectance"


@dataclass(frozen=True)
class VqvaeConfig(TokenizerConfig):
    """Sizes and losses of the VQ-VAE; the defaults are the paper's for KITTI odometry.

    Args:
        channels: number of channels at the finest level, a multiple of 32.
        channel_multipliers: channels of each level, from fine to coarse, over those of the finest; each further level
            halves rows and columns, or rows alone; see ``cell_columns``.
        cell_columns: number of columns of the cell of pixels that a token stands for; 0 for as many as rows. With fewer
            than rows, the first levels halve rows alone: a pole then fills its cell from side to side.
        residual_blocks: number of residual blocks of each encoder level; a decoder level has one more.
        num_codes: number of codes in the codebook.
        dropout: probability of dropout within residual blocks.
        padding: values beyond the first and the last column: ``zero`` as in the reference; ``wrap`` closes the circle
            of azimuth.
        range_encoding: map from metres to [-1, 1]; ``linear`` is the paper's.
        raydrop_loss: whether a return mask is decoded beside the range, with its own loss (RL in the paper's ablation).
            Without it one channel learns the range image with its holes.
        raydrop_weight: weight of that loss, lambda, if there is one; 0.1 in the paper, 0.0001 in the released
            configuration for KITTI odometry.
        reconstruction: pixels that the error of the range covers, and its divisor; without the raydrop loss it covers
            all pixels. ``paper``: the clean range at returns, divided by the number of all pixels. ``reference``: a
            mask is sampled first, only its pixels count, and the sum is divided by the returns of each scan.
            ``returns``: the clean range at returns, divided by their number in each scan.
        error_unit: ``encoded`` for the error between encodings, as in the paper; ``metres`` for the error between
            ranges, scaled so that with the linear encoding the two are equal. With the logarithmic encoding the first
            weighs near surfaces more, the second far ones.
        reflectance: whether reflectance is encoded and decoded beside the range; not so in the paper. Both are mapped
            to [-1, 1], and their errors weigh alike, as in R2DM and LiDARGen.
        codebook_loss: ``paper``, ``reference``, ``vqvae`` or ``ema``; see lidargrit.nn.codebook.
        restart_dead_codes: whether codes that are hardly ever used restart from latents, so that the codebook does not
            collapse; the reference has no such remedy.
    """

    channels: Annotated[int, Bounds(32, multiple_of=32)] = 64  # the norms share 32 groups
    channel_multipliers: Annotated[tuple[Count, ...], Bounds(1, _LEVELS_AT_MOST)] = (1, 1, 2)
    cell_columns: NotNegative = 0
    residual_blocks: ResidualBlocks = 1
    code_dim: CodeDim = 128
    num_codes: NumCodes = 512
    dropout: ShareBelow1 = 0.2
    padding: Padding = "zero"
    range_encoding: EncodingName = "linear"
    raydrop_loss: bool = True
    raydrop_weight: Weight = 0.1
    reconstruction: Literal["paper", "reference", "returns"] = "paper"
    error_unit: Literal["encoded", "metres"] = "encoded"
    reflectance: bool = False
    codebook_loss: CodebookLoss = "paper"
    restart_dead_codes: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.cell_columns not in (0, *(2**halvings for halvings in range(len(self.channel_multipliers)))):
            rows = 2 ** (len(self.channel_multipliers) - 1)
            wanted = f"a power of 2 up to the {rows} rows of a cell, or 0 for as many"
            raise ConfigError(f"cell_columns={self.cell_columns}", wanted, "lower it, or add channel_multipliers")

    @property
    def cell(self) -> tuple[int, int]:
        """Rows and columns of the cell of pixels that a token stands for."""
        rows = 2 ** (len(self.channel_multipliers) - 1)
        return rows, self.cell_columns or rows

    def halves_columns(self, level: int) -> bool:
        """Return whether columns are halved between a level and the next coarser one."""
        rows, columns = self.cell
        return rows >> (level + 1) < columns


def _block(config: VqvaeConfig, inputs: int, outputs: int) -> ResidualBlock:
    return ResidualBlock(inputs, outputs, config.dropout, config.padding)


def _level(config: VqvaeConfig, inputs: int, width: int, num_blocks: int) -> Level:
    """Make residual blocks; what halves or doubles rows and columns after them is added by the caller."""
    widths = [inputs, *[width] * num_blocks]
    return Level([_block(config, *pair) for pair in pairwise(widths)])


class Encoder(ConvolutionalEncoder):
    """The network from encoded range, and perhaps reflectance, (B, channels, H, W) to latents (B, code_dim, h, w)."""

    def __init__(self, config: VqvaeConfig) -> None:
        super().__init__()
        c, widths = config, _widths(config)
        self.conv_in = Convolution(1 + c.reflectance, c.channels, c.padding)
        self.down = nn.ModuleList()
        for level, (inputs, width) in enumerate(pairwise([c.channels, *widths])):
            self.down.append(made := _level(c, inputs, width, c.residual_blocks))
            if level < len(widths) - 1:
                made.downsample = Downsample(width, c.padding, column_stride=1 + c.halves_columns(level))
        self.mid = _middle(c)
        self.norm_out = group_norm(widths[-1])
        self.conv_out = Convolution(widths[-1], c.code_dim, c.padding)


class Decoder(ConvolutionalDecoder):
    """The network from latents (B, code_dim, h, w) to encoded range, return logits and reflectance, if it has these.

    The encoded range is given before tanh, the reflectance as a logit.
    """

    def __init__(self, config: VqvaeConfig) -> None:
        super().__init__()
        c, widths = config, _widths(config)
        self.conv_in = Convolution(c.code_dim, widths[-1], c.padding)
        self.mid = _middle(c)
        coarse_to_fine = []
        for level, (inputs, width) in enumerate(pairwise([widths[-1], *reversed(widths)])):
            coarse_to_fine.append(made := _level(c, inputs, width, c.residual_blocks + 1))
            if (finer := len(widths) - 2 - level) >= 0:
                made.upsample = Upsample(width, c.padding, c.halves_columns(finer))
        self.up = nn.ModuleList(reversed(coarse_to_fine))
        self.norm_out = group_norm(widths[0])
        self.conv_out = Convolution(widths[0], 1 + c.raydrop_loss + c.reflectance, c.padding)

    def prepared(self, precision: Precision) -> "Decoder":
        """Return a copy for decoding only, quicker: channels last, upsampling folded, perhaps in 16 bits.

        The last layers stay in 32 bits: 16 would leave 8 of them for a range, steps of 0.2 m at 80 m.
        """
        fast = copy.deepcopy(self).eval().requires_grad_(False)
        for level in fast.up:
            assert isinstance(level, Level)
            if isinstance(level.upsample, Upsample) and level.upsample.factors == (2.0, 2.0):
                level.upsample = FoldedUpsample(level.upsample)
        for layer in (fast.conv_in, fast.mid, fast.up):
            layer.to(dtype_of(precision))
        for weight in fast.parameters():
            if weight.ndim == 4:
                weight.data = weight.contiguous(memory_format=torch.channels_last)
        return fast


class Vqvae(ConvolutionalTokenizer[VqvaeConfig]):
    """The adapted VQ-VAE of LidarGRIT.

    Source:
        Haghighi et al., LidarGRIT, 2024, section 3.2; layer sizes and state-dict names as in
        hamedhaghighi/LidarGRIT@a3f86e7.
    """

    def __init__(self, config: VqvaeConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        rows, columns = config.cell
        if sensor.height % rows or sensor.width % columns:
            both = (
                f"both sizes divisible by {rows}"
                if rows == columns
                else f"rows divisible by {rows}, columns by {columns}"
            )
            raise ConfigError(
                f"range images of {sensor.height}x{sensor.width}",
                f"{both}, for {len(config.channel_multipliers)} levels",
                "use fewer channel_multipliers, or another number of columns",
            )
        self.grid_size = (sensor.height // rows, sensor.width // columns)
        self.num_features = _widths(config)[0]
        self.range_encoding = RangeEncoding(config.range_encoding, sensor.range_min_m, sensor.range_max_m)
        self.encoder, self.decoder = Encoder(config), Decoder(config)
        self._add_codebook(config.num_codes, config.code_dim, config.codebook_loss, config.restart_dead_codes)

    def _encoded(self, images: RangeImage) -> Float[Tensor, "B C H W"]:
        encoded = self.range_encoding.encode(images.range_m, images.return_mask)
        if not self.config.reflectance:
            return encoded[:, None]
        reflectance = required_reflectance(images.reflectance, _SETTING)
        return torch.stack((encoded, 2 * reflectance * images.return_mask - 1), 1)

    def decode(self, tokens: TokenGrid) -> Decoded:
        """Return clean range, return logits, perhaps reflectance, and the last feature maps of a batch of tokens."""
        features = self.decoder.features(self.post_quant_conv(self.quantize.lookup(tokens.tokens)))
        encoded, return_logits, reflectance = self._heads(self.decoder.conv_out(features))
        return Decoded(self.range_encoding.decode(encoded), return_logits, self.sensor, reflectance, features)

    def for_decoding(self, precision: Precision) -> "Vqvae":
        """Return a tokenizer with the same weights that only decodes, quicker; see :meth:`Decoder.prepared`."""
        fast = copy.copy(self)
        fast._modules = {**self._modules, "decoder": self.decoder.prepared(precision)}
        return fast

    def decoding_flops(self) -> int:
        """Return the floating-point operations of decoding one scan as :meth:`for_decoding` does."""
        latents = (1, self.config.code_dim, *self.grid_size)
        return flops_of(self.post_quant_conv, latents) + flops_of(self.decoder.prepared("fp32"), latents)

    def check(self, images: RangeImage) -> None:
        """Refuse images without the reflectance that is to be learned."""
        if self.config.reflectance:
            required_reflectance(images.reflectance, _SETTING)

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return the loss of eq. 5 of the paper and its terms, the range error in metres, and the mask's accuracy."""
        images = example.images
        z = self.quantize(self.latents(images), rng)
        encoded, return_logits, reflectance = self._heads(self.decoder(self.post_quant_conv(z.latents)))
        mask, encoding = images.return_mask, self.range_encoding
        range_m = encoding.decode(encoded)
        if self.config.error_unit == "metres":
            target_m = images.range_m.clamp(encoding.range_min_m, encoding.range_max_m)
            pair = encoding.unit_range(range_m), torch.where(mask, encoding.unit_range(target_m), -1.0)
        else:
            pair = encoded, encoding.encode(images.range_m, mask)
        terms = {"commitment": z.loss, "codebook_perplexity": self.quantize.perplexity()}
        if self.config.raydrop_loss:
            kind = self.config.reconstruction
            kept = torch.bernoulli(return_logits.detach().sigmoid(), generator=rng) > 0 if kind == "reference" else mask
            terms["reconstruction"] = reconstruction_loss(*pair, mask, kept, kind)
            terms["raydrop"] = F.binary_cross_entropy_with_logits(return_logits, mask.to(return_logits.dtype))
            loss = terms["reconstruction"] + self.config.raydrop_weight * terms["raydrop"] + z.loss
        else:
            terms["reconstruction"] = (pair[0] - pair[1]).abs().mean()  # holes are learned as the range -1
            loss = terms["reconstruction"] + z.loss
        if reflectance is not None:
            error = reconstruction_loss(
                2 * reflectance - 1, 2 * required_reflectance(images.reflectance, _SETTING) - 1, mask, mask, "returns"
            )
            loss = loss + error
            terms["reflectance_mae"] = error.detach() / 2
        with torch.no_grad():
            error_m = (range_m - images.range_m).abs()
            terms["range_mae_m"] = (error_m * mask).sum() / mask.sum().clamp(min=1)
            terms["mask_accuracy"] = ((return_logits >= 0) == mask).float().mean()
        return {"loss": loss, **terms}

    def _heads(
        self, raw: Float[Tensor, "B heads H W"]
    ) -> tuple[Float[Tensor, "B H W"], Float[Tensor, "B H W"], Float[Tensor, "B H W"] | None]:
        """Return encoded range, return logits and, if there is any, reflectance of the last layer's output."""
        raw = at_least_32_bits(raw)
        encoded = raw[:, 0].tanh()
        reflectance = raw[:, -1].sigmoid() if self.config.reflectance else None
        if self.config.raydrop_loss:
            return encoded, raw[:, 1], reflectance
        return encoded, torch.where(encoded > _NO_RETURN_BELOW, math.inf, -math.inf), reflectance


def reconstruction_loss(
    encoded: Float[Tensor, "B H W"],
    target: Float[Tensor, "B H W"],
    return_mask: Bool[Tensor, "B H W"],
    sampled_mask: Bool[Tensor, "B H W"],
    kind: Literal["paper", "reference", "returns"],
) -> Float[Tensor, ""]:
    """Return the masked absolute error of the encoded range on the pixels that truly returned.

    Args:
        sampled_mask: returns that were sampled, for ``reference``.
        kind: pixels that count, and the divisor.

    Source:
        ``paper``: eq. 2, clean range over all pixels. ``reference``: hamedhaghighi/LidarGRIT@a3f86e7, range composed
        with a sampled mask, over each scan's returns.
    """
    if kind == "reference":
        encoded = torch.where(sampled_mask, encoded, -1.0)
    error = (encoded - target).abs() * return_mask
    if kind == "paper":
        return error.mean()
    return (error.sum((1, 2)) / return_mask.sum((1, 2)).clamp(min=1)).mean()


def _widths(config: VqvaeConfig) -> list[int]:
    """Return the channels of every level, from fine to coarse."""
    return [config.channels * multiplier for multiplier in config.channel_multipliers]


def _middle(config: VqvaeConfig) -> nn.Sequential:
    width = _widths(config)[-1]
    return nn.Sequential(OrderedDict((name, _block(config, width, width)) for name in ("block_1", "block_2")))
