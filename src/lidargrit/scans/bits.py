"""Bits of scans by a model: tokens, mask and ranges of each → negative log-likelihood by scan and by pixel."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidargrit.core.errors import ConfigError


@dataclass(frozen=True, eq=False)
class ScanBits:
    """Negative log-likelihood of each scan of a batch in bits, by parts.

    Args:
        step_mm: step in millimetres that ranges are rounded to.
        tokens: bits of each token, given those before it.
        mask: bits of the return or ray drop of each pixel, given the tokens; None from a model that has no such
            probability.
        range: bits of the range of each pixel, given tokens and mask, 0 where there is no return; None from a model
            that has no such probability.
        expected: expected bits of mask and range of each pixel (the entropy), given all that comes before it; None if
            not asked for.
    """

    step_mm: int
    return_mask: Bool[Tensor, "B H W"]
    tokens: Float[Tensor, "B h w"]
    mask: Float[Tensor, "B H W"] | None = None
    range: Float[Tensor, "B H W"] | None = None
    expected: Float[Tensor, "B H W"] | None = None

    @classmethod
    def cat(cls, batches: "Sequence[ScanBits]") -> "ScanBits":
        """Make one batch of several batches of one model, by one step."""
        first = batches[0]
        parts = {
            name: torch.cat([getattr(batch, name) for batch in batches])
            for name in ("return_mask", "tokens", "mask", "range", "expected")
            if getattr(first, name) is not None
        }
        return replace(first, **parts)

    @property
    def is_whole(self) -> bool:
        """Whether the bits name the whole scan; tokens alone leave open what is lost in encoding."""
        return self.mask is not None and self.range is not None

    def per_scan(self) -> dict[str, Float[Tensor, "B"]]:
        """Return the bits of each part of each scan, by the part's name, in 64 bits."""
        parts = {"tokens": self.tokens, "mask": self.mask, "range": self.range}
        return {name: bits.double().sum((1, 2)) for name, bits in parts.items() if bits is not None}

    def total(self) -> Float[Tensor, "B"]:
        """Return the bits of each scan, all parts together, in 64 bits."""
        return torch.stack([*self.per_scan().values()]).sum(0)

    def per_pixel(self) -> Float[Tensor, "B H W"]:
        """Return the bits of each pixel: of its mask, its range, and an even share of its token's."""
        height, width = self.return_mask.shape[1:]
        rows, columns = height // self.tokens.shape[1], width // self.tokens.shape[2]
        bits = self.tokens.repeat_interleave(rows, 1).repeat_interleave(columns, 2) / (rows * columns)
        for part in (self.mask, self.range):
            bits = bits if part is None else bits + part
        return bits

    def anomaly(self) -> Float[Tensor, "B H W"]:
        """Return by how many bits each pixel's mask and range exceed their expected bits; 0 on average for usual scans.

        Raises:
            ConfigError: the expected bits were not asked for, or the model does not tell them.
        """
        if self.mask is None or self.range is None or self.expected is None:
            raise ConfigError(
                "bits without those that were expected",
                "both, from a model with a pixel decoder",
                "ask for them: model.bits(images, expected=True)",
            )
        return self.mask + self.range - self.expected
