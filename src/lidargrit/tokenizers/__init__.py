"""Range image ⇄ tokens: the contract of a tokenizer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lidargrit.errors import ConfigError
from lidargrit.sensors import SensorModel
from lidargrit.structures import RangeImage, TokenGrid

MaskDecoding = Literal["bernoulli", "threshold"]


class Decoded(NamedTuple):
    """What a decoder says of every pixel: a clean range in metres, and the logit that a beam came back at all."""

    range_m: Float[Tensor, "B H W"]
    return_logits: Float[Tensor, "B H W"]


class Tokenizer(nn.Module, ABC):
    """Turns range images of one sensor into a grid of tokens and back."""

    sensor: SensorModel
    num_codes: int
    grid_size: tuple[int, int]

    @abstractmethod
    def forward(self, images: RangeImage, rng: torch.Generator) -> dict[str, Tensor]:
        """Return the training objective as ``loss``, and beside it what is worth watching."""

    @abstractmethod
    def encode(self, images: RangeImage) -> TokenGrid:
        """Return the tokens (B, h, w) of a batch."""

    @abstractmethod
    def decode_parts(self, tokens: TokenGrid) -> Decoded:
        """Return clean range and return logits of a batch of tokens, before any mask is drawn."""

    def decode(
        self, tokens: TokenGrid, mask: MaskDecoding = "threshold", uniform: Float[Tensor, "B H W"] | None = None
    ) -> RangeImage:
        """Return range images of a batch of tokens.

        Args:
            tokens: (B, h, w).
            mask: ``threshold`` keeps a pixel whose P(return) is at least 0.5 (the paper); ``bernoulli`` draws it with
                that probability (the authors' program).
            uniform: the random numbers in [0, 1) that ``bernoulli`` compares with.

        Raises:
            ConfigError: ``bernoulli`` without random numbers.
        """
        range_m, return_logits = self.decode_parts(tokens)
        if mask == "threshold":
            return_mask = return_logits >= 0
        elif uniform is None:
            raise ConfigError(
                "a Bernoulli mask without random numbers",
                "uniform (B, H, W) in [0, 1)",
                "e.g. torch.rand(size, generator=rng)",
            )
        else:
            return_mask = uniform < return_logits.sigmoid()
        return RangeImage.masked(range_m, return_mask, self.sensor)
