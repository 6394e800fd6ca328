"""The contract of a tokenizer, which turns range images into tokens and back, and how a configuration names it."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from lidargrit.core import discovery
from lidargrit.core.configuration import NamedConfig
from lidargrit.generation.objective import Objective
from lidargrit.nn.codebook import VectorQuantiser
from lidargrit.nn.codes import CodeFeatures
from lidargrit.nn.precision import Precision
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import Decoded, MaskDecoding, RangeImage, TokenGrid


@dataclass(frozen=True)
class TokenizerConfig(NamedConfig):
    """Base of the tokenizers' configurations; the file that defines one, and the tokenizer with it, is its name."""

    package: ClassVar[str] = "tokenizers"
    default_name: ClassVar[str] = "vqvae"


Config = TypeVar("Config", bound=TokenizerConfig)


class Tokenizer(Objective, Generic[Config]):
    """Turns range images of one sensor into a grid of tokens and back; an objective of training as it stands.

    A new tokenizer is one file of this folder with two public classes: a ``TokenizerConfig`` and the ``Tokenizer`` that
    is made of it and a sensor. Every generator over tokens takes it by its configuration.

    Attributes:
        config: its configuration.
        sensor: the rays and limits of its range images.
        num_codes: number of different tokens.
        grid_size: rows and columns of the token grid.
        num_features: channels of ``Decoded.features``; 0 if ``decode`` gives none.
        num_components: components of ``Decoded.components``; 1 if ``decode`` gives ranges alone.
    """

    num_codes: int
    grid_size: tuple[int, int]
    num_features: int = 0
    num_components: int = 1

    def __init__(self, config: Config, sensor: SensorModel) -> None:
        super().__init__(sensor)
        self.config = config

    @abstractmethod
    def encode(self, images: RangeImage) -> TokenGrid:
        """Return the tokens (B, h, w) of a batch."""

    @abstractmethod
    def decode(self, tokens: TokenGrid) -> Decoded:
        """Decode a batch of tokens (B, h, w) to ranges and return logits of every pixel."""

    @abstractmethod
    def decoding_flops(self) -> int:
        """Return the floating-point operations of decoding one scan as :meth:`for_decoding` does."""

    def code_features(self) -> CodeFeatures | None:
        """Return numbers that tell what every code stands for, where that is known without training; else None."""
        return None

    def for_decoding(self, precision: Precision) -> "Tokenizer[Config]":
        """Return a tokenizer with the same weights that only decodes, perhaps quicker or in 16 bits."""
        return self

    def sample(
        self, tokens: TokenGrid, rngs: Sequence[torch.Generator], mask: MaskDecoding = "bernoulli"
    ) -> RangeImage:
        """Return one scan for each token grid of a batch, its random numbers from its own generator.

        Args:
            tokens: token grids (B, h, w).
            rngs: random generators on the CPU, one for each scan.
            mask: ``bernoulli`` samples each return with its probability (the authors' program); ``threshold`` keeps a
                return whose probability is at least 0.5 (the paper).
        """
        decoded = self.decode(tokens)
        return decoded.threshold() if mask == "threshold" else decoded.sample(rngs)

    @torch.no_grad()
    def reconstruct(self, images: RangeImage) -> RangeImage:
        """Encode and decode a batch of scans, the mask by threshold."""
        return self.decode(self.encode(images)).threshold()


class CodebookTokenizer(Tokenizer[Config]):
    """A tokenizer whose tokens are the codes nearest to continuous latents.

    A generator may sample latents instead of tokens, and have them quantised before they are decoded.

    Attributes:
        quantize: codebook.
    """

    quantize: VectorQuantiser

    @abstractmethod
    def latents(self, images: RangeImage) -> Float[Tensor, "B D h w"]:
        """Return the continuous latents of a batch, before quantisation."""

    def encode(self, images: RangeImage) -> TokenGrid:
        """Return the tokens (B, h, w) of a batch."""
        return self.quantised(self.latents(images).float())

    def quantised(self, latents: Float[Tensor, "B D h w"]) -> TokenGrid:
        """Return the tokens (B, h, w) of latents."""
        tokens = self.quantize.nearest(latents.movedim(1, -1).flatten(0, -2))
        return TokenGrid.unchecked(tokens.unflatten(0, (len(latents), *latents.shape[2:])), self.num_codes)

    def warnings(self) -> list[str]:
        """Return a line with the remedy if the codebook has collapsed."""
        return self.quantize.warnings(
            "raise the budget or lower model.tokenizer.num_codes"
            if self.quantize.restart_dead
            else "--set model.tokenizer.restart_dead_codes=true model.tokenizer.codebook_loss=ema"
        )


def make_tokenizer(config: TokenizerConfig, sensor: SensorModel) -> Tokenizer[Any]:
    """Return a tokenizer of the kind that the configuration is of, with fresh weights."""
    kind: type[Tokenizer[Any]] = discovery.load_class("tokenizers", config.name(), Tokenizer)
    return kind(config, sensor)
