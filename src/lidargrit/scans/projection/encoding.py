"""Encoding of ranges for networks: metres ⇄ [-1, 1], with -1 for no return."""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class RangeEncoding:
    """A monotone map of [range_min_m, range_max_m] onto [-1, 1].

    ``linear`` is the paper's. ``log`` is log2(1 + range) as in R2DM, but between the limits given here. ``inverse`` is
    -1/range, after DUSty's 1/range. In all three, far is +1.

    Source:
        linear: hamedhaghighi/LidarGRIT@a3f86e7. The paper gives no formula.
    """

    kind: Literal["linear", "log", "inverse"]
    range_min_m: float
    range_max_m: float

    def encode(self, range_m: Float[Tensor, "*shape"], return_mask: Bool[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """Map metres to [-1, 1]; pixels without a return become -1."""
        low, high = self._curve(self.range_min_m), self._curve(self.range_max_m)
        curve = self._curve_of(range_m.clamp(self.range_min_m, self.range_max_m))
        return torch.where(return_mask, (curve - low) * (2 / (high - low)) - 1, -1.0)

    def decode(self, encoded: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """Map [-1, 1] to metres; values outside are clamped to the limits."""
        low, high = self._curve(self.range_min_m), self._curve(self.range_max_m)
        curve = (encoded.clamp(-1, 1) + 1) * ((high - low) / 2) + low
        if self.kind == "log":
            curve = torch.exp2(curve) - 1
        elif self.kind == "inverse":
            curve = -1 / curve
        return curve.clamp(self.range_min_m, self.range_max_m)

    def unit_range(self, range_m: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """Map metres linearly to [-1, 1], whatever the kind of the encoding: the unit of errors in metres."""
        return (range_m - self.range_min_m) * (2 / (self.range_max_m - self.range_min_m)) - 1

    def _curve(self, range_m: float) -> float:
        return {"linear": range_m, "log": math.log2(1 + range_m), "inverse": -1 / range_m}[self.kind]

    def _curve_of(self, range_m: Tensor) -> Tensor:
        if self.kind == "log":
            return torch.log2(1 + range_m)
        return -1 / range_m if self.kind == "inverse" else range_m
