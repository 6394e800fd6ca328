"""Encoding of ranges for networks: metres ⇄ [-1, 1], with -1 for no return."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

EncodingName = Literal["linear", "log", "inverse"]


class _Curve(NamedTuple):
    """What is encoded linearly, of a number and of a tensor in metres, and back."""

    of_number: Callable[[float], float]
    of: Callable[[Tensor], Tensor]
    back: Callable[[Tensor], Tensor]


_CURVES: dict[EncodingName, _Curve] = {
    "linear": _Curve(lambda range_m: range_m, lambda range_m: range_m, lambda curve: curve),
    "log": _Curve(
        lambda range_m: math.log2(1 + range_m), lambda range_m: torch.log2(1 + range_m), lambda curve: curve.exp2() - 1
    ),
    "inverse": _Curve(lambda range_m: -1 / range_m, lambda range_m: -1 / range_m, lambda curve: -1 / curve),
}


@dataclass(frozen=True)
class RangeEncoding:
    """A monotone map of [range_min_m, range_max_m] onto [-1, 1].

    ``linear`` is the paper's. ``log`` is log2(1 + range), in R2DM and R2Flow from 0 m on. ``inverse`` is -1/range,
    after DUSty's 1/range. In all three, far is +1.

    Source:
        linear: hamedhaghighi/LidarGRIT@a3f86e7. The paper gives no formula.
    """

    kind: EncodingName
    range_min_m: float
    range_max_m: float

    def encode(self, range_m: Float[Tensor, "*shape"], return_mask: Bool[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """Map metres to [-1, 1]; pixels without a return become -1."""
        low, high = self._ends()
        curve = _CURVES[self.kind].of(range_m.clamp(self.range_min_m, self.range_max_m))
        return torch.where(return_mask, (curve - low) * (2 / (high - low)) - 1, -1.0)

    def decode(self, encoded: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """Map [-1, 1] to metres; values outside are clamped to the limits."""
        return _CURVES[self.kind].back(self.curve(encoded)).clamp(self.range_min_m, self.range_max_m)

    def curve(self, encoded: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """Map [-1, 1] to what is linear in it: the range, log2(1 + range) or -1 / range."""
        low, high = self._ends()
        return (encoded.clamp(-1, 1) + 1) * ((high - low) / 2) + low

    def unit_range(self, range_m: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """Map metres linearly to [-1, 1], whatever the kind of the encoding: the unit of errors in metres."""
        return (range_m - self.range_min_m) * (2 / (self.range_max_m - self.range_min_m)) - 1

    def _ends(self) -> tuple[float, float]:
        of_number = _CURVES[self.kind].of_number
        return of_number(self.range_min_m), of_number(self.range_max_m)
