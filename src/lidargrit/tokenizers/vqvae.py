"""The paper's first stage, a VQ-VAE that decodes clean range and raydrop apart: range images ⇄ tokens."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from lidargrit.errors import ConfigError
from lidargrit.nn.blocks import Network
from lidargrit.nn.convolution import (
    Convolution,
    Downsample,
    FoldedUpsample,
    Padding,
    ResidualBlock,
    Upsample,
    group_norm,
)
from lidargrit.nn.precision import Precision, dtype_of
from lidargrit.nn.quantiser import CodebookLoss, VectorQuantiser
from lidargrit.projection import RangeEncoding
from lidargrit.sensors import SensorModel
from lidargrit.structures import RangeImage, TokenGrid
from lidargrit.tokenizers import Decoded, Tokenizer

_COLLAPSED_BELOW = 0.05  # of the codes in effect used; healthy codebooks of ours keep above half
_NO_RETURN_BELOW = -0.9  # without a raydrop head, an encoded range below this is read as no return (the program's rule)


@dataclass(frozen=True)
class VqvaeConfig:
    """Sizes and losses of the VQ-VAE; the defaults are the paper's for KITTI odometry.

    Args:
        channels: of the finest level; a multiple of 32.
        channel_multipliers: of every level from fine to coarse; each further level halves rows and columns.
        residual_blocks: of every encoder level (a decoder level has one more).
        code_dim: length of a code.
        num_codes: size of the codebook.
        dropout: within residual blocks.
        padding: ``zero`` is the reference's; ``wrap`` closes the circle of azimuth.
        range_encoding: how metres become [-1, 1]; ``linear`` is the paper's.
        raydrop_loss: decode a return mask beside the range and train it (RL in the paper's ablation). Without it one
            channel learns the range image with its holes.
        raydrop_weight: lambda; the paper's 0.1. The released configuration for KITTI odometry has 0.0001.
        reconstruction: ``paper`` takes the clean range and divides by all pixels; ``reference`` draws the mask first,
            which lets only kept pixels learn, and divides by the returns of each scan; ``returns`` takes the clean
            range and divides by the returns of each scan.
        error_unit: ``encoded`` takes the error between encodings, as the paper does; ``metres`` between ranges, scaled
            so that for the linear encoding the two are the same. With the logarithmic encoding the first cares for near
            surfaces, the second for far ones.
        codebook_loss: ``paper``, ``reference``, ``vqvae`` or ``ema``; see lidargrit.nn.quantiser.
        restart_dead_codes: the remedy against a collapsing codebook; the reference has none.
    """

    channels: int = 64
    channel_multipliers: tuple[int, ...] = (1, 1, 2)
    residual_blocks: int = 1
    code_dim: int = 128
    num_codes: int = 512
    dropout: float = 0.2
    padding: Padding = "zero"
    range_encoding: Literal["linear", "log", "inverse"] = "linear"
    raydrop_loss: bool = True
    raydrop_weight: float = 0.1
    reconstruction: Literal["paper", "reference", "returns"] = "paper"
    error_unit: Literal["encoded", "metres"] = "encoded"
    codebook_loss: CodebookLoss = "paper"
    restart_dead_codes: bool = True

    def __post_init__(self) -> None:
        if self.channels < 32 or self.channels % 32:
            raise ConfigError(
                f"channels={self.channels}", "a positive multiple of 32", "the norms share 32 groups: round it up"
            )
        for name in ("residual_blocks", "code_dim", "num_codes"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name}={getattr(self, name)}", "at least 1", "raise it")
        if not self.channel_multipliers or min(self.channel_multipliers) < 1:
            raise ConfigError(
                f"channel_multipliers={self.channel_multipliers}", "one positive number a level", "e.g. (1,1,2)"
            )
        if not 0 <= self.dropout < 1:
            raise ConfigError(f"dropout={self.dropout}", "a share in [0, 1)", "lower it")


class Encoder(Network):
    """Encoded range (B, 1, H, W) → latents (B, code_dim, h, w)."""

    def __init__(self, config: VqvaeConfig) -> None:
        super().__init__()
        c, padding = config, config.padding
        widths = [c.channels * m for m in c.channel_multipliers]
        self.conv_in = Convolution(1, c.channels, padding)
        self.down = nn.ModuleList()
        inputs = c.channels
        for level, width in enumerate(widths):
            stage = nn.Module()
            blocks = [
                ResidualBlock(inputs if i == 0 else width, width, c.dropout, padding) for i in range(c.residual_blocks)
            ]
            stage.add_module("block", nn.ModuleList(blocks))
            if level < len(widths) - 1:
                stage.add_module("downsample", Downsample(width, padding))
            self.down.append(stage)
            inputs = width
        self.mid = _middle(inputs, c.dropout, padding)
        self.norm_out = group_norm(inputs)
        self.conv_out = Convolution(inputs, c.code_dim, padding)

    def forward(self, x: Float[Tensor, "B 1 H W"]) -> Float[Tensor, "B D h w"]:
        """Shrink the image to its latents."""
        x = self.conv_in(x)
        for stage in self.down:
            for layer in [*stage.get_submodule("block").children(), *_named(stage, "downsample")]:
                x = layer(x)
        for block in self.mid.children():
            x = block(x)
        return self.conv_out(F.silu(self.norm_out(x)))


class Decoder(Network):
    """Latents (B, code_dim, h, w) → encoded range before tanh, and return logits if there is a raydrop head."""

    def __init__(self, config: VqvaeConfig) -> None:
        super().__init__()
        c, padding = config, config.padding
        widths = [c.channels * m for m in c.channel_multipliers]
        inputs = widths[-1]
        self.conv_in = Convolution(c.code_dim, inputs, padding)
        self.mid = _middle(inputs, c.dropout, padding)
        stages: list[nn.Module] = []
        for level, width in reversed(list(enumerate(widths))):
            stage = nn.Module()
            blocks = [
                ResidualBlock(inputs if i == 0 else width, width, c.dropout, padding)
                for i in range(c.residual_blocks + 1)
            ]
            stage.add_module("block", nn.ModuleList(blocks))
            if level > 0:
                stage.add_module("upsample", Upsample(width, padding))
            stages.insert(0, stage)  # the reference numbers its levels from the finest
            inputs = width
        self.up = nn.ModuleList(stages)
        self.norm_out = group_norm(inputs)
        self.conv_out = Convolution(inputs, 2 if c.raydrop_loss else 1, padding)

    def forward(self, z: Float[Tensor, "B D h w"]) -> Float[Tensor, "B heads H W"]:
        """Grow the latents to an image."""
        x = self.conv_in(z.to(self.conv_in.weight))
        for block in self.mid.children():
            x = block(x)
        for stage in reversed(list(self.up)):
            for layer in [*stage.get_submodule("block").children(), *_named(stage, "upsample")]:
                x = layer(x)
        return self.conv_out(F.silu(self.norm_out(x.to(self.conv_out.weight.dtype))))

    def prepared(self, precision: Precision) -> Decoder:
        """Return a copy for decoding only, quicker: channels last, upsampling folded, perhaps in 16 bits.

        The last layers stay in 32 bits: 16 would leave 8 of them for a range, steps of 0.2 m at 80 m.
        """
        fast = copy.deepcopy(self).eval().requires_grad_(False)
        for stage in fast.up:
            for upsample in _named(stage, "upsample"):
                assert isinstance(upsample, Upsample)
                stage.add_module("upsample", FoldedUpsample(upsample))
        for layer in (fast.conv_in, fast.mid, fast.up):
            layer.to(dtype_of(precision))
        for weight in fast.parameters():
            if weight.ndim == 4:
                weight.data = weight.contiguous(memory_format=torch.channels_last)
        return fast


class Vqvae(Tokenizer):
    """The adapted VQ-VAE of LidarGRIT.

    Args:
        config: sizes and losses.
        sensor: the rays and limits of the range images it learns.

    Raises:
        ConfigError: the image cannot be halved as often as the configuration wants.

    Source:
        Haghighi et al., LidarGRIT, 2024, section 3.2; layer sizes and state-dict names as in
        hamedhaghighi/LidarGRIT@a3f86e7.
    """

    def __init__(self, config: VqvaeConfig, sensor: SensorModel) -> None:
        super().__init__()
        factor = 2 ** (len(config.channel_multipliers) - 1)
        if sensor.height % factor or sensor.width % factor:
            raise ConfigError(
                f"range images of {sensor.height}x{sensor.width}",
                f"both sizes divisible by {factor}, for {len(config.channel_multipliers)} levels",
                "use fewer channel_multipliers, or another number of columns",
            )
        self.config, self.sensor, self.num_codes = config, sensor, config.num_codes
        self.grid_size = (sensor.height // factor, sensor.width // factor)
        self.range_encoding = RangeEncoding(config.range_encoding, sensor.range_min_m, sensor.range_max_m)
        self.encoder, self.decoder = Encoder(config), Decoder(config)
        self.quantize = VectorQuantiser(
            config.num_codes, config.code_dim, config.codebook_loss, config.restart_dead_codes
        )
        self.quant_conv = nn.Conv2d(config.code_dim, config.code_dim, 1)
        self.post_quant_conv = nn.Conv2d(config.code_dim, config.code_dim, 1)

    def latents(self, images: RangeImage) -> Float[Tensor, "B D h w"]:
        """Return the continuous latents of a batch, before quantisation."""
        if images.range_m.ndim != 3:
            raise ConfigError("a single range image", "a batch", "make one with RangeImage.stack([image])")
        encoded = self.range_encoding.encode(images.range_m, images.return_mask)
        return self.quant_conv(self.encoder(encoded[:, None]))

    def encode(self, images: RangeImage) -> TokenGrid:
        """Return the tokens (B, h, w) of a batch."""
        z = self.latents(images).float()
        tokens = self.quantize.nearest(z.movedim(1, -1).flatten(0, -2)).unflatten(0, (len(z), *z.shape[2:]))
        return TokenGrid(tokens, self.num_codes)

    def decode_parts(self, tokens: TokenGrid) -> Decoded:
        """Return clean range and return logits of a batch of tokens."""
        encoded, return_logits = self._heads(self.quantize.lookup(tokens.tokens))
        return Decoded(self.range_encoding.decode(encoded), return_logits)

    def for_decoding(self, precision: Precision) -> Vqvae:
        """Return a tokenizer with the same weights that only decodes, quicker; see :meth:`Decoder.prepared`."""
        fast = copy.copy(self)
        fast._modules = {**self._modules, "decoder": self.decoder.prepared(precision)}
        return fast

    def forward(self, images: RangeImage, rng: torch.Generator) -> dict[str, Tensor]:
        """Return the loss of eq. 5 of the paper and its terms, with the error in metres and the mask's accuracy."""
        z = self.quantize(self.latents(images), rng)
        encoded, return_logits = self._heads(z.latents)
        target, mask = self.range_encoding.encode(images.range_m, images.return_mask), images.return_mask
        terms = {"commitment": z.loss, "codebook_perplexity": torch.tensor(self.quantize.perplexity())}
        pair = (encoded, target)
        if self.config.error_unit == "metres":
            pair = (self.range_encoding.unit_range(encoded), self.range_encoding.unit_range(target))
        if self.config.raydrop_loss:
            kind = self.config.reconstruction
            kept = torch.bernoulli(return_logits.detach().sigmoid(), generator=rng) > 0 if kind == "reference" else mask
            terms["reconstruction"] = reconstruction_loss(*pair, mask, kept, kind)
            terms["raydrop"] = F.binary_cross_entropy_with_logits(return_logits, mask.to(return_logits.dtype))
            loss = terms["reconstruction"] + self.config.raydrop_weight * terms["raydrop"] + z.loss
        else:
            terms["reconstruction"] = (pair[0] - pair[1]).abs().mean()  # holes are learned as the range -1
            loss = terms["reconstruction"] + z.loss
        with torch.no_grad():
            error_m = (self.range_encoding.decode(encoded) - images.range_m).abs()
            terms["range_mae_m"] = (error_m * mask).sum() / mask.sum().clamp(min=1)
            terms["mask_accuracy"] = ((return_logits >= 0) == mask).float().mean()
        return {"loss": loss, **terms}

    def warnings(self) -> list[str]:
        """Return what a person should know of the codebook: nothing, or that it has collapsed, and the remedy."""
        perplexity, used = self.quantize.perplexity(), self.quantize.used_share()
        if perplexity >= _COLLAPSED_BELOW * self.num_codes:
            return []
        remedy = (
            "raise the budget or lower model.tokenizer.num_codes"
            if self.config.restart_dead_codes
            else "--set model.tokenizer.restart_dead_codes=true model.tokenizer.codebook_loss=ema"
        )
        return [
            f"the codebook has collapsed: {perplexity:.1f} of {self.num_codes} codes in effect, {used:.0%} alive; "
            f"the remedy: {remedy}"
        ]

    def _heads(self, latents: Float[Tensor, "B D h w"]) -> tuple[Float[Tensor, "B H W"], Float[Tensor, "B H W"]]:
        raw = self.decoder(self.post_quant_conv(latents)).float()
        encoded = raw[:, 0].tanh()
        if self.config.raydrop_loss:
            return encoded, raw[:, 1]
        return encoded, torch.where(encoded > _NO_RETURN_BELOW, math.inf, -math.inf)


def reconstruction_loss(
    encoded: Float[Tensor, "B H W"],
    target: Float[Tensor, "B H W"],
    return_mask: Bool[Tensor, "B H W"],
    drawn_mask: Bool[Tensor, "B H W"],
    kind: Literal["paper", "reference", "returns"],
) -> Float[Tensor, ""]:
    """Return the masked absolute error of the encoded range on the pixels that truly returned.

    Source:
        ``paper``: eq. 2, clean range over all pixels. ``reference``: hamedhaghighi/LidarGRIT@a3f86e7, range composed
        with a drawn mask, over each scan's returns.
    """
    if kind == "reference":
        encoded = torch.where(drawn_mask, encoded, -1.0)
    error = (encoded - target).abs() * return_mask
    if kind == "paper":
        return error.mean()
    return (error.sum((1, 2)) / return_mask.sum((1, 2)).clamp(min=1)).mean()


def _middle(channels: int, dropout: float, padding: Padding) -> nn.Module:
    middle = nn.Module()
    for name in ("block_1", "block_2"):
        middle.add_module(name, ResidualBlock(channels, channels, dropout, padding))
    return middle


def _named(stage: nn.Module, name: str) -> list[nn.Module]:
    return [module for key, module in stage.named_children() if key == name]
