"""A number of columns around the circle → the azimuths of their centres."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor


def column_azimuths_rad(columns: int, stride: int = 1) -> Float[Tensor, "1 W"]:
    """Return the azimuths of the centres of every ``stride``-th of ``columns`` equal columns, from +pi down to -pi."""
    index = torch.arange(0, columns, stride, dtype=torch.float64)
    return (math.pi - 2 * math.pi * (index + 0.5) / columns).float()[None]
