"""Summaries of sets of range images: sets → mean images, and the most similar pairs of scans, to plot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64

from lidargrit.determinism import evenly_spaced
from lidargrit.evaluation.pairs import EvalSet
from lidargrit.projection import points_of_pixels

HALF_VIEW_M = 50.0  # beyond it a 64-row sensor sees little but walls
_CELLS = 100  # of 1 m, along each axis
_BATCH = 16
_ROWS, _COLUMNS = (
    32,
    128,
)  # pixels that are compared: enough to tell streets apart, and few enough for thousands of pairs
_GENERATED_AT_MOST, _REAL_AT_MOST = 500, 2000  # scans that are compared one by one: a few seconds


@dataclass(frozen=True, eq=False)
class Profile:
    """Mean images of a set of scans.

    Args:
        mean_range_m: mean range of each pixel over its returns, in metres; NaN for a pixel without returns.
        return_rate: share of scans with a return, for each pixel.
        density: points per scan in each square metre; row 0 is behind the sensor, column 0 on its right.
    """

    mean_range_m: Float64[np.ndarray, "H W"]
    return_rate: Float64[np.ndarray, "H W"]
    density: Float64[np.ndarray, "x y"]


@dataclass(frozen=True)
class Match:
    """A generated scan and the reference scan that is most like it.

    Args:
        generated: index of the generated scan in its set.
        real: index of the reference scan in its set.
        distance: mean absolute difference of log2(1 + range in metres) over pixels, where no return counts as 0.
    """

    generated: int
    real: int
    distance: float


@torch.no_grad()
def profile(scans: EvalSet) -> Profile:
    """Return the means over all compared scans of a set."""
    sensor = scans.images.sensor
    total = torch.zeros(sensor.height, sensor.width, dtype=torch.float64)
    returns = torch.zeros_like(total)
    cells = torch.zeros(_CELLS * _CELLS, dtype=torch.float64)
    for first in range(0, len(scans), _BATCH):
        images = scans.batch(range(first, min(first + _BATCH, len(scans))))
        total += images.range_m.double().sum(dim=0)
        returns += images.return_mask.sum(dim=0)
        points = points_of_pixels(images)[images.return_mask][:, :2]
        cell = ((points + HALF_VIEW_M) * (_CELLS / (2 * HALF_VIEW_M))).floor().long()
        cell = cell[((cell >= 0) & (cell < _CELLS)).all(dim=1)]
        cells += torch.bincount(cell[:, 0] * _CELLS + cell[:, 1], minlength=_CELLS * _CELLS)
    mean = torch.where(returns > 0, total / returns, torch.nan)
    return Profile(mean.numpy(), (returns / len(scans)).numpy(), (cells / len(scans)).view(_CELLS, _CELLS).numpy())


def matches(samples: EvalSet, reference: EvalSet) -> list[Match]:
    """Return the nearest reference scan of every generated one, the most alike first.

    Of many scans 500 generated and 2,000 real ones are compared, evenly spaced.
    """
    chosen, known = evenly_spaced(_GENERATED_AT_MOST, len(samples)), evenly_spaced(_REAL_AT_MOST, len(reference))
    distance = torch.cdist(_outlines(samples, chosen), _outlines(reference, known), p=1) / (_ROWS * _COLUMNS)
    nearest = distance.min(dim=1)
    found = [
        Match(generated, known[int(real)], float(apart))
        for generated, real, apart in zip(chosen, nearest.indices, nearest.values, strict=True)
    ]
    return sorted(found, key=lambda match: match.distance)


def _outlines(scans: EvalSet, indices: list[int]) -> Float[torch.Tensor, "n pixels"]:
    """Return some pixels of each scan, as logarithms: a metre matters more nearby."""
    sensor = scans.images.sensor
    rows = torch.linspace(0, sensor.height - 1, _ROWS).round().long()
    columns = torch.linspace(0, sensor.width - 1, _COLUMNS).round().long()
    parts = []
    for first in range(0, len(indices), _BATCH):
        range_m = scans.batch(indices[first : first + _BATCH]).range_m
        parts.append(torch.log2(1 + range_m[:, rows][:, :, columns]).flatten(1))
    return torch.cat(parts)
