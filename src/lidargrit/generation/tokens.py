"""Base of generators of tokens, with any tokenizer and any order of sampling."""

import math
from abc import abstractmethod
from dataclasses import dataclass, field, fields, replace
from typing import Literal, TypeVar

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from lidargrit.core.configuration import Settings
from lidargrit.core.errors import ConfigError
from lidargrit.generation.encoding_cache import EncodingCache, Frozen
from lidargrit.generation.facts import Cost, SamplingSettings
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective
from lidargrit.generation.pixel_decoder.phase_network import PixelDecoderConfig
from lidargrit.generation.pixel_decoder.pixel_decoder import PixelDecoder, PixelSampling, nats_to_range_bits
from lidargrit.generation.range_steps import RangeSteps
from lidargrit.generation.tokenizers import Tokenizer, TokenizerConfig, make_tokenizer
from lidargrit.generation.tokenizers.vqvae import VqvaeConfig
from lidargrit.nn.collectives import sum_over_processes
from lidargrit.nn.precision import Precision, in_full, products_in
from lidargrit.nn.transformer import Transformer, TransformerConfig, resample_positions
from lidargrit.scans.bits import ScanBits
from lidargrit.scans.condition import Observed
from lidargrit.scans.example import Example
from lidargrit.scans.fills import fill_from_nearest
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import Decoded, RangeImage, TokenGrid

_DECODED_AT_ONCE = 4  # scans on a CPU, where more would only take memory: 35 MB a layer at 64x1024


PixelChoice = Literal["auto", "pixels", "bernoulli", "threshold"]
"""How the pixels of sampled tokens are decided: by the pixel decoder, or by the tokenizer's decoder alone."""


@dataclass(frozen=True, kw_only=True)
class DecodingOfTokens(SamplingSettings):
    """Settings by which range images are made of sampled tokens, whatever samples the tokens.

    Args:
        mask: method by which returns and ranges are decided. ``pixels`` samples both by the pixel decoder, phase by
            phase. ``bernoulli`` samples each return with its probability, independently of the others, and keeps the
            decoded ranges (the released program, so what the paper's scores were computed with). ``threshold`` keeps a
            return that is at least as likely as not (the paper's eq. 1). ``auto`` is ``pixels`` where there is a pixel
            decoder, and ``bernoulli`` elsewhere.
        range_temperature: temperature of the pixel decoder's density of ranges on one surface; below 1 ranges keep to
            the surface more precisely; 0 takes the model's own (``model.pixels.range_temperature``). Only scans sampled
            with temperatures, noise and guidance of 1 and a correlation of 0 follow the distribution whose likelihood
            the model gives.
        surface_temperature: temperature of the pixel decoder's choice between surfaces that lie apart; below 1 edges of
            objects are less ragged; 0 takes the model's own (``model.pixels.surface_temperature``).
        mask_temperature: temperature of the pixel decoder's returns that are neither rare nor nearly certain; below 1
            windows are closed; 0 takes the model's own (``model.pixels.mask_temperature``).
        range_noise: multiplier of the pixel decoder's spread of ranges about a surface.
        mask_correlation: multiplier of how much of their noise close pixels of the pixel decoder's mask share that are
            sampled at once; 0 samples them independently.
        decoder: number type of the tokenizer's decoder and of the pixel decoder. ``fp32`` is exact; ``bf16`` is
            quicker, moves ranges a little and a few pixels to another surface; ``auto`` is ``bf16`` where the machine
            has instructions for it. ``tf32`` rounds what a GPU multiplies to 11 digits.
    """

    mask: PixelChoice = "auto"
    range_temperature: float = PixelSampling.range_temperature
    surface_temperature: float = PixelSampling.surface_temperature
    mask_temperature: float = PixelSampling.mask_temperature
    range_noise: float = PixelSampling.range_noise
    mask_correlation: float = PixelSampling.mask_correlation
    decoder: Precision = "fp32"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.pixels()

    def pixels(self) -> PixelSampling:
        """Return the settings of the pixel decoder."""
        return PixelSampling(
            range_temperature=self.range_temperature,
            surface_temperature=self.surface_temperature,
            mask_temperature=self.mask_temperature,
            range_noise=self.range_noise,
            mask_correlation=self.mask_correlation,
            precision=self.decoder,
        )


@dataclass(frozen=True)
class TokenGeneratorConfig(Settings):
    """The networks of a generator of tokens.

    Args:
        tokenizer: configuration of any tokenizer.
        transformer: sizes of the transformer that models the tokens.
        pixels: sizes of a pixel decoder, which samples returns and ranges in phases; none in the paper.
    """

    tokenizer: TokenizerConfig = field(default_factory=VqvaeConfig)
    transformer: TransformerConfig = field(default_factory=TransformerConfig)
    pixels: PixelDecoderConfig | None = None


TokenConfigT = TypeVar("TokenConfigT", bound=TokenGeneratorConfig)
SamplingT = TypeVar("SamplingT", bound=SamplingSettings)


class TokenGenerator(Generator[TokenConfigT, SamplingT]):
    """A tokenizer, trained first, and a ``transformer`` over its tokens, trained over the frozen tokenizer.

    A third stage, ``pixels``, trains a pixel decoder over the frozen tokenizer, if the configuration has one.
    """

    Config = TokenGeneratorConfig
    trains = (("tokenizer", "tokenizer"), ("transformer", "transformer"), ("pixels", "pixels"))
    capabilities = frozenset({"tokens", "encode", "likelihood"})

    def __init__(self, config: TokenConfigT, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        self.tokenizer = make_tokenizer(config.tokenizer, sensor)
        self.pixels: PixelDecoder | None = None
        if config.pixels is not None:
            if not self.tokenizer.num_features:
                raise ConfigError(
                    f"model.pixels over the tokenizer {config.tokenizer.name()!r}, whose decoder gives no features",
                    "a tokenizer with features, such as vqvae",
                    "choose another tokenizer, or leave model.pixels out",
                )
            tokenizer = self.tokenizer
            self.pixels = PixelDecoder(config.pixels, sensor, tokenizer.num_features, tokenizer.num_components)

    @abstractmethod
    def transformer_objective(self) -> Objective:
        """Return the objective of the transformer over the frozen tokenizer."""

    def objective(self, stage: str) -> Objective:
        """Return the tokenizer itself, or the objective of a network over the frozen tokenizer."""
        if stage == "pixels" and self.pixels is not None:
            return PixelObjective(self.pixels, self.tokenizer)
        return self.tokenizer if stage == "tokenizer" else self.transformer_objective()

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> TokenConfigT:
        """Return a VQ-VAE of one block a level, and a transformer of one layer."""
        tokenizer = VqvaeConfig(channels=32, channel_multipliers=(1, 1, 1, 1), code_dim=8, num_codes=32)
        return cls.Config(tokenizer, TransformerConfig(layers=1, heads=2, width=16))

    def get_tokenizer(self) -> Tokenizer:
        """Return the tokenizer."""
        return self.tokenizer

    def _reconstruct(self, images: RangeImage) -> RangeImage:
        """Return what the tokens keep of a batch of scans, the mask by threshold."""
        return self.tokenizer.reconstruct(images)

    def check_choice(self, mask: PixelChoice, pixels: PixelSampling) -> None:
        """Refuse, before any token is sampled, a choice of the pixel decoder where there is none, and changed settings
        of it where it samples nothing, with ConfigError."""
        if mask == "pixels" and self.pixels is None:
            raise ConfigError(
                "mask=pixels for a model without a pixel decoder",
                "a model with one",
                "leave mask out, or train a preset with the stage pixels, such as lidargrit_compact_pixels",
            )
        if self.pixels is None or mask not in ("auto", "pixels"):
            of_networks = replace(PixelSampling(), precision=pixels.precision)  # that of the tokenizer's decoder, too
            for each in fields(pixels):
                if getattr(pixels, each.name) != getattr(of_networks, each.name):
                    without = "a model without one" if self.pixels is None else f"mask={mask}"
                    got = f"{each.name}={getattr(pixels, each.name)}, which the pixel decoder reads, for {without}"
                    cure = "leave it out" if self.pixels is None else "leave it out, or take mask=pixels"
                    raise ConfigError(got, "settings that have an effect", cure)

    def decode(
        self,
        tokens: Int[Tensor, "B T"],
        wanted: int,
        rngs: list[torch.Generator],
        mask: PixelChoice,
        pixels: PixelSampling,
        tokenizer: Tokenizer,
        condition: Observed | None = None,
    ) -> RangeImage:
        """Decode sampled tokens to scans: those that are wanted, and perhaps the rest of the last one's batch.

        Scans are decoded in batches of one size, as tokens are sampled, because kernels differ by the size; on a GPU
        all of them at once. On a CPU the pixel decoder samples scan by scan, and those that are wanted alone.

        Args:
            tokens: tokens of a batch of scans in raster order.
            wanted: number of scans to return; the rest are the copies of ``BatchSeeds``.
            mask: method by which returns and ranges are decided, checked by :meth:`check_choice`.
            tokenizer: the generator's own tokenizer, or its copy for decoding only.
        """
        images = []
        at_once, last = (_DECODED_AT_ONCE, wanted) if tokens.device.type == "cpu" else (len(tokens), len(tokens))
        for first in range(0, wanted, at_once):
            some = slice(first, first + at_once)
            grid = TokenGrid.unchecked(tokens[some].unflatten(1, tokenizer.grid_size), tokenizer.num_codes)
            with products_in(pixels.precision):
                if self.pixels is not None and mask in ("auto", "pixels"):
                    part = None if condition is None else condition[some]
                    own = rngs[first : min(first + at_once, last)]
                    images.append(self.pixels.sample(tokenizer.decode(grid), own, pixels, part))
                else:
                    method = "threshold" if mask == "threshold" else "bernoulli"
                    images.append(tokenizer.sample(grid, rngs[some], method))
        return RangeImage.cat(images)

    def observed_tokens(self, condition: Observed) -> Int[Tensor, "B T"]:
        """Return the tokens of all cells with an observed pixel, and -1 for the others.

        They are the tokens of scans in which every unobserved pixel is a copy of the nearest observed one by angle.
        """
        observed = condition.return_observed | condition.range_observed
        filled = fill_from_nearest(condition.surfaces, observed)
        rows, columns = self.tokenizer.grid_size
        cell = (self.sensor.height // rows, self.sensor.width // columns)
        seen = F.max_pool2d(observed[:, None].float(), cell)[:, 0] > 0
        return torch.where(seen, self.tokenizer.encode(filled).tokens, -1).flatten(1)

    def _bits(self, images: RangeImage, steps: RangeSteps, expected: bool) -> ScanBits:
        """Return the bits of the tokens, and those of mask and ranges given the tokens, if there is a pixel decoder."""
        grid = self.tokenizer.encode(images)
        tokens = self.token_bits(grid)
        if self.pixels is None:
            return ScanBits(steps.step_mm, images.return_mask, tokens)
        decoded = self.tokenizer.decode(grid)
        return ScanBits(steps.step_mm, images.return_mask, tokens, *self.pixels.bits(decoded, images, steps, expected))

    def token_bits(self, grid: TokenGrid) -> Float[Tensor, "B h w"]:
        """Return the bits of each token if all tokens are equally likely.

        A generator whose transformer gives exact probabilities of tokens returns their bits instead.
        """
        return torch.full(grid.tokens.shape, math.log2(grid.num_codes), device=grid.tokens.device)

    def decoding_cost(self, mask: PixelChoice) -> Cost:
        """Return the cost of decoding the tokens of one scan, and of its pixel decoder if that samples them."""
        flops = self.tokenizer.decoding_flops()
        if self.pixels is None or mask not in ("auto", "pixels"):
            return Cost(1, flops)
        return Cost(1 + self.pixels.num_evaluations, flops + self.pixels.flops())


class TokenObjective(Objective):
    """Base of the objectives of transformers over the tokens of a frozen tokenizer."""

    over = ("tokenizer",)
    keeps_encodings = True
    token_counts: Tensor

    def __init__(self, tokenizer: Tokenizer, transformer: Transformer) -> None:
        super().__init__(tokenizer.sensor)
        self.transformer, self.grid_size = transformer, tokenizer.grid_size
        self._tokens = EncodingCache(tokenizer, _tokens)
        self.register_buffer("token_counts", torch.ones(transformer.num_tokens))

    def weights_from(self, trained: Objective) -> dict[str, Tensor]:
        """Return the weights of a trained transformer, with its positions resampled to this one's columns of tokens."""
        weights = super().weights_from(trained)
        if isinstance(trained, TokenObjective):
            ours, theirs = self.grid_size, trained.grid_size
            if ours[0] == theirs[0] and ours != theirs:
                name, rows = "transformer.pos_emb", ours[0]
                if "transformer.column_emb" in weights:  # positions in a window stay as they are
                    name, rows = "transformer.column_emb", 1
                weights[name] = resample_positions(weights[name], (rows, theirs[1]), ours[1])
        return weights

    @torch.no_grad()
    def encode(self, example: Example) -> tuple[Int[Tensor, "B T"], Float[Tensor, "B T"]]:
        """Return the tokens, and their negative log-likelihood in nats by a model that knows only token frequencies."""
        tokens = self._tokens(example.images, example.keys).long().flatten(1)
        if self.training:
            ones = torch.ones_like(tokens, dtype=self.token_counts.dtype).flatten()
            self.token_counts += sum_over_processes(
                torch.zeros_like(self.token_counts).index_add_(0, tokens.flatten(), ones)
            )
        return tokens, -(self.token_counts / self.token_counts.sum()).log()[tokens]


class PixelObjective(Objective):
    """Objective of a pixel decoder: negative log-likelihood of the pixels, given the tokens of a tokenizer if any.

    Args:
        pixels: the pixel decoder.
        tokenizer: the frozen tokenizer; None for a pixel decoder without tokens.
    """

    reaches_all_weights = False  # some phases stand for all

    def __init__(self, pixels: PixelDecoder, tokenizer: Tokenizer | None = None) -> None:
        super().__init__(pixels.sensor)
        self.pixels = pixels
        self._tokens = None if tokenizer is None else EncodingCache(tokenizer, _tokens)
        self._decoding = None if tokenizer is None else Frozen(tokenizer.for_decoding("fp32"))
        self.over = () if tokenizer is None else ("tokenizer",)
        self.keeps_encodings = tokenizer is not None

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return the nats of the mask a pixel plus those of the range a return as ``loss``, and each of them in bits.

        In training some phases of each scan stand for all; in validation all are counted.
        """
        images, decoded = example.images, self.decoded(example, rng)
        pixels = self.pixels.for_sensor(images.sensor)
        if self.training:
            mask_nats, range_nats = pixels.estimate(decoded, images, rng)
        else:
            nll = pixels(decoded, images)
            mask_nats, range_nats = nll.mask.mean(), nll.range.sum() / images.return_mask.sum().clamp(min=1)
        bits = {"mask_bits": mask_nats / math.log(2), "range_bits": nats_to_range_bits(range_nats)}
        return {"loss": mask_nats + range_nats, **{name: value.detach() for name, value in bits.items()}}

    def decoded(self, example: Example, rng: torch.Generator) -> Decoded | None:
        """Return what the pixel decoder is given of each scan besides its own pixels; None for nothing."""
        if self._tokens is None or self._decoding is None:
            return None
        device = example.images.range_m.device
        tokenizer = self._decoding.network(device)
        with torch.no_grad(), in_full(device):  # as when scans are sampled
            tokens = self._tokens(example.images, example.keys).long()
            return tokenizer.decode(TokenGrid.unchecked(tokens, tokenizer.num_codes))


def _tokens(tokenizer: Tokenizer, images: RangeImage) -> Int[Tensor, "B h w"]:
    return tokenizer.encode(images).tokens.int()  # half as many bytes to keep
