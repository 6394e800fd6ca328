"""Azimuths of columns: of the centres of a number of equal ones, and the means of a table of all pixels."""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def column_azimuths_rad(columns: int, stride: int = 1, first_edge_rad: float = math.pi) -> Float[Tensor, "1 W"]:
    """Return the azimuths of the centres of every ``stride``-th of ``columns`` equal columns, from +pi down to -pi.

    Args:
        columns: number of columns around the circle.
        stride: number of columns of which one is taken.
        first_edge_rad: azimuth at which the first column begins.
    """
    index = torch.arange(0, columns, stride, dtype=torch.float64)
    return (first_edge_rad - 2 * math.pi * (index + 0.5) / columns).float()[None]


def mean_azimuths_rad(azimuth_rad: Float[Tensor, "H W"]) -> Float[Tensor, " W"]:
    """Return the mean azimuth of every column around the circle, in 64 bits, from -pi to +pi."""
    table = azimuth_rad.double()
    return torch.atan2(table.sin().mean(dim=0), table.cos().mean(dim=0))


def continuous_azimuths_rad(azimuth_rad: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Return azimuths without a jump of a full turn from one column or row to the next, in 64 bits."""
    of_columns = mean_azimuths_rad(azimuth_rad)
    turns = ((of_columns.diff(prepend=of_columns[:1]) + math.pi) / (2 * math.pi)).floor().cumsum(0)
    of_columns = of_columns - 2 * math.pi * turns
    aside = azimuth_rad.double() - of_columns
    return of_columns + torch.atan2(aside.sin(), aside.cos())
