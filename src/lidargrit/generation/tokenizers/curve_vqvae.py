"""LiDM's first stage, a VQ-VAE whose finest levels shorten the rows alone, curve by curve."""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Bounds, Count, Positive
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
from lidargrit.nn.blocks import Block
from lidargrit.nn.codebook import CodebookLoss
from lidargrit.nn.convolution import Convolution, Downsample, ResidualBlock, group_norm
from lidargrit.nn.flops import flops_of
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import Decoded, RangeImage, TokenGrid

_NOTHING_M = 1e-4  # is added to every range by the logarithmic encoding
_THRESHOLD_UNIT = 1 / 255  # of the encoded range: nearer values are no return
_THRESHOLD_MARGIN = 1e-6
_CURVE = (1, 4)  # rows and columns of the kernels of levels that mix no rows
_SQUARE = (3, 3)


@dataclass(frozen=True)
class CurveVqvaeConfig(TokenizerConfig):
    """Sizes and losses of the VQ-VAE; the defaults are those of LiDM's ``f_c2_p4``: curves of 2, then patches of 4.

    Args:
        channels: number of channels at the finest level, a multiple of 32.
        channel_multipliers: channels of each level, from fine to coarse, over those of the finest.
        row_strides: number of rows of each level that become one row at the next coarser level, 1 or 2; columns are
            always halved.
        residual_blocks: number of residual blocks of each encoder level; a decoder level has one more.
        num_codes: number of codes in the codebook.
        range_encoding: map from metres to [-1, 1]; LiDM's models with ``*`` in their names have the linear one.
        range_scale: encoded range that becomes 1: log2(1 + range in metres), or metres for the linear encoding. 5.84
            and 56 are published, and end at 56.3 and 56 m. Longer ranges are learned as no return. LiDM's program also
            drops what is decoded to 56 m and more; here that is a return.
        mask_head: whether a second channel of the decoder learns which beams return. Without it, a range of a few
            millimetres stands for no return.
        codebook_loss: ``paper``, ``reference``, ``vqvae`` or ``ema``; see lidargrit.nn.codebook. LiDM's program has
            the same bug as ``reference``.
        restart_dead_codes: whether codes that are hardly ever used restart from latents; LiDM's program does not do
            this.
    """

    channels: Annotated[int, Bounds(32, multiple_of=32)] = 64  # the norms share 32 groups
    channel_multipliers: Annotated[tuple[Count, ...], Bounds(1, 16)] = (1, 2, 2, 4)
    row_strides: tuple[Literal[1, 2], ...] = (1, 2, 2)
    residual_blocks: ResidualBlocks = 2
    code_dim: CodeDim = 8
    num_codes: NumCodes = 16_384
    range_encoding: Literal["log", "linear"] = "log"
    range_scale: Positive = 5.84
    mask_head: bool = False
    codebook_loss: CodebookLoss = "reference"
    restart_dead_codes: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        multipliers, strides = self.channel_multipliers, self.row_strides
        if len(multipliers) != len(strides) + 1:
            raise ConfigError(
                f"channel_multipliers={multipliers}, row_strides={strides}",
                "one stride between each two multipliers",
                "e.g. channel_multipliers=(1,2,2,4) row_strides=(1,2,2)",
            )
        if self.range_encoding == "log" and self.range_scale > 16:
            raise ConfigError(f"range_scale={self.range_scale}", "at most 16 for log", "5.84 is published")

    def widths(self) -> list[int]:
        """Return the channels of every level, from fine to coarse."""
        return [self.channels * multiplier for multiplier in self.channel_multipliers]


def _level(inputs: int, width: int, num_blocks: int, kernel: tuple[int, int]) -> Level:
    widths = [inputs, *[width] * num_blocks]
    return Level([ResidualBlock(*pair, 0.0, "wrap", kernel) for pair in pairwise(widths)])


class CurveUpsample(nn.Module):
    """Double the columns, and perhaps the rows, by linear interpolation between the corners, then convolve."""

    def __init__(self, channels: int, row_stride: int) -> None:
        super().__init__()
        self.row_stride = row_stride
        self.conv = Convolution(channels, channels, "wrap", (1, 5) if row_stride == 1 else _SQUARE)

    def forward(self, x: Float[Tensor, "B C h w"]) -> Float[Tensor, "B C H W"]:
        """Double the columns, and the rows if so made."""
        factors = (float(self.row_stride), 2.0)
        return self.conv(F.interpolate(x, scale_factor=factors, mode="bilinear", align_corners=True))


class LatentAttention(Block):
    """Self-attention between all latents, with one head."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = group_norm(channels)
        self.q, self.k, self.v, self.proj_out = (nn.Conv2d(channels, channels, 1) for _ in range(4))

    def forward(self, x: Float[Tensor, "B C h w"]) -> Float[Tensor, "B C h w"]:
        """Add what each latent finds."""
        normed = self.norm(x)
        q, k, v = (layer(normed).flatten(2).transpose(1, 2)[:, None] for layer in (self.q, self.k, self.v))
        seen = F.scaled_dot_product_attention(q, k, v)[:, 0].transpose(1, 2)
        return x + self.proj_out(seen.unflatten(2, x.shape[2:]))


class CurveMiddle(nn.Module):
    """The blocks at the coarsest level, with attention between them."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.block_1 = ResidualBlock(width, width, 0.0, "wrap")
        self.attn_1 = LatentAttention(width)
        self.block_2 = ResidualBlock(width, width, 0.0, "wrap")

    def forward(self, x: Float[Tensor, "B C h w"]) -> Float[Tensor, "B C h w"]:
        """Return feature maps of the same size."""
        return self.block_2(self.attn_1(self.block_1(x)))


class CurveEncoder(ConvolutionalEncoder):
    """The network from encoded range (B, 1, H, W) to latents (B, code_dim, h, w)."""

    def __init__(self, config: CurveVqvaeConfig) -> None:
        super().__init__()
        widths = config.widths()
        self.conv_in = Convolution(1, config.channels, "wrap")
        pairs = pairwise([config.channels, *widths])
        levels = [_level(*pair, config.residual_blocks, _SQUARE) for pair in pairs]
        for level, width, row_stride in zip(levels, widths, config.row_strides, strict=False):  # not the coarsest
            level.downsample = Downsample(width, "wrap", row_stride)
        self.down = nn.ModuleList(levels)
        self.mid = CurveMiddle(widths[-1])
        self.norm_out = group_norm(widths[-1])
        self.conv_out = Convolution(widths[-1], config.code_dim, "wrap")


class CurveDecoder(ConvolutionalDecoder):
    """The network from latents (B, code_dim, h, w) to encoded range and, if it has the head, returns as 1 and -1."""

    def __init__(self, config: CurveVqvaeConfig) -> None:
        super().__init__()
        widths = config.widths()
        self.conv_in = Convolution(config.code_dim, widths[-1], "wrap")
        self.mid = CurveMiddle(widths[-1])
        levels = []  # from coarse to fine; the finest level has no stride of its own, and is a curve's
        strides = [*reversed(config.row_strides), 1]
        for pair, row_stride in zip(pairwise([widths[-1], *reversed(widths)]), strides, strict=True):
            kernel = _CURVE if row_stride == 1 else _SQUARE
            level = _level(*pair, config.residual_blocks + 1, kernel)
            if len(levels) < len(config.row_strides):
                level.upsample = CurveUpsample(pair[1], row_stride)
            levels.append(level)
        self.up = nn.ModuleList(reversed(levels))
        self.norm_out = group_norm(widths[0])
        self.conv_out = Convolution(widths[0], 1 + config.mask_head, "wrap", _CURVE)


class CurveVqvae(ConvolutionalTokenizer[CurveVqvaeConfig]):
    """The autoencoder of LiDM.

    Its discriminator is left out, whose weight is 0 after the first two steps because the program's condition is
    inverted, and so are its terms of geometry and of perception, which are off in the published configuration.

    Source:
        Ran et al., Towards Realistic Scene Generation with LiDAR Diffusion Models, CVPR 2024, section 3.2; layers,
        names and losses as in hancyran/LiDAR-Diffusion@8416ddb (MIT), whose published size has 15,070,361 parameters.
    """

    def __init__(self, config: CurveVqvaeConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        factors = math.prod(config.row_strides), 2 ** len(config.row_strides)
        if sensor.height % factors[0] or sensor.width % factors[1]:
            raise ConfigError(
                f"range images of {sensor.height}x{sensor.width}",
                f"rows divisible by {factors[0]}, columns by {factors[1]}, for row_strides={config.row_strides}",
                "use fewer strides, or another number of columns",
            )
        self.grid_size = (sensor.height // factors[0], sensor.width // factors[1])
        self.encoder, self.decoder = CurveEncoder(config), CurveDecoder(config)
        self._add_codebook(config.num_codes, config.code_dim, config.codebook_loss, config.restart_dead_codes)

    def _encoded(self, images: RangeImage) -> Float[Tensor, "B 1 H W"]:
        return encode_range(images.range_m, self.config)[:, None]

    def decode(self, tokens: TokenGrid) -> Decoded:
        """Return range and returns of a batch of tokens; the logits of returns are infinite, for nothing is random."""
        raw = self.decoder(self.post_quant_conv(self.quantize.lookup(tokens.tokens))).float()
        range_m, returned = self._heads(raw)
        return Decoded(range_m, torch.where(returned, math.inf, -math.inf), self.sensor)

    def decoding_flops(self) -> int:
        """Return the floating-point operations of decoding one scan."""
        latents = (1, self.config.code_dim, *self.grid_size)
        return flops_of(self.post_quant_conv, latents) + flops_of(self.decoder, latents)

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return the loss and its terms, the range error in metres, and the mask's accuracy."""
        images = example.images
        z = self.quantize(self.latents(images), rng)
        raw = self.decoder(self.post_quant_conv(z.latents)).float()
        encoded = encode_range(images.range_m, self.config)
        learned = encoded >= return_threshold(self.config)  # returns that the encoding reaches
        terms = {"commitment": z.loss, "codebook_perplexity": self.quantize.perplexity()}
        terms["reconstruction"] = (raw[:, 0] - encoded).abs().mean()
        loss = terms["reconstruction"]
        if self.config.mask_head:
            terms["raydrop"] = (raw[:, 1] - torch.where(learned, 1.0, -1.0)).abs().mean()
            loss = (loss + terms["raydrop"]) / 2  # the program divides the sum by the number of its terms
        with torch.no_grad():
            range_m, returned = self._heads(raw)
            error_m = (range_m - images.range_m).abs()
            terms["range_mae_m"] = (error_m * learned).sum() / learned.sum().clamp(min=1)
            terms["mask_accuracy"] = (returned == images.return_mask).float().mean()
        return {"loss": loss + z.loss, **terms}

    def _heads(self, raw: Float[Tensor, "B heads H W"]) -> tuple[Float[Tensor, "B H W"], Bool[Tensor, "B H W"]]:
        """Return range in metres within the sensor's limits, and which beams return."""
        values, limits = raw[:, 0], (self.sensor.range_min_m, self.sensor.range_max_m)
        range_m = decode_range(values, self.config)
        returned = (values >= return_threshold(self.config)) & (range_m > limits[0]) & (range_m < limits[1])
        if self.config.mask_head:
            returned &= raw[:, 1] >= 0
        return range_m.clamp(*limits), returned


def encode_range(range_m: Float[Tensor, "*shape"], config: CurveVqvaeConfig) -> Float[Tensor, "*shape"]:
    """Map metres to [-1, 1]; no return, 0 m, and ranges beyond the encoding lie at its lower end."""
    if config.range_encoding == "linear":
        return _cut(range_m / config.range_scale, 0.0)
    nothing = math.log2(1 + _NOTHING_M) / config.range_scale
    return _cut(torch.log2(range_m + _NOTHING_M + 1) / config.range_scale, nothing)


def decode_range(values: Float[Tensor, "*shape"], config: CurveVqvaeConfig) -> Float[Tensor, "*shape"]:
    """Map [-1, 1] to metres; values outside are clamped. The 0.1 mm that the encoding adds stays, as in the program."""
    share = (values.clamp(-1, 1) + 1) / 2 * config.range_scale
    return share if config.range_encoding == "linear" else torch.exp2(share) - 1


def return_threshold(config: CurveVqvaeConfig) -> float:
    """Return the encoded range below which there is no return: 4 mm."""
    unit = math.log2(1 + _THRESHOLD_UNIT) if config.range_encoding == "log" else _THRESHOLD_UNIT
    return 2 * unit / config.range_scale - 1 + _THRESHOLD_MARGIN


def _cut(share: Float[Tensor, "*shape"], nothing: float) -> Float[Tensor, "*shape"]:
    return 2 * torch.where(share > 1, nothing, share) - 1
