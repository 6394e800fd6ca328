"""Summaries of sets of range images: sets → mean images, and the most similar pairs of scans, to plot."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float64

from lidargrit.core.determinism import evenly_spaced
from lidargrit.evaluation.pairs import EvalSet
from lidargrit.scans.projection import points_of_pixels

HALF_VIEW_M = 50.0  # beyond it a 64-row sensor sees little but walls
_CELLS = 100  # of 1 m, along each axis
_BATCH = 16
MATCHED_ROWS, MATCHED_COLUMNS = 32, 128  # pixels compared: enough to tell streets apart, few enough for many pairs
MATCHED_AT_MOST, SEARCHED_AT_MOST = 500, 10_000  # samples, and reference scans: at most a minute of one core
_BLOCK = 1000  # reference scans in memory at once, as 16 MB of pixels


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
        generated: index of the generated scan among those that are compared.
        real: index of the reference scan among those that are searched.
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


def searched_scans(reference: EvalSet) -> EvalSet:
    """Return the reference with all of its scans in place of those that are compared, to search for nearest ones.

    Of more than 10,000 these are 10,000, evenly spaced.
    """
    return replace(reference, indices=evenly_spaced(SEARCHED_AT_MOST, len(reference.images)))


def matches(samples: EvalSet, reference: EvalSet) -> list[Match]:
    """Return the nearest reference scan of every generated one, the most alike first.

    Args:
        samples: set of generated scans; of more than 500 these are 500, evenly spaced.
        reference: set that is searched, as :func:`searched_scans` returns it.
    """
    chosen = evenly_spaced(MATCHED_AT_MOST, len(samples))
    ours = _outlines(samples, chosen)
    distance, nearest = torch.full((len(chosen),), torch.inf), torch.zeros(len(chosen), dtype=torch.int64)
    for first in range(0, len(reference), _BLOCK):
        theirs = _outlines(reference, range(first, min(first + _BLOCK, len(reference))))
        apart, at = (torch.cdist(ours, theirs, p=1) / ours.shape[1]).min(dim=1)
        nearest = torch.where(apart < distance, first + at, nearest)
        distance = torch.minimum(apart, distance)
    found = map(Match, chosen, nearest.tolist(), distance.tolist())
    return sorted(found, key=lambda match: match.distance)


def _outlines(scans: EvalSet, indices: Sequence[int]) -> Float[torch.Tensor, "n pixels"]:
    """Return some pixels of each scan, as logarithms: a metre matters more nearby."""
    sensor = scans.images.sensor
    rows = torch.linspace(0, sensor.height - 1, MATCHED_ROWS).round().long()
    columns = torch.linspace(0, sensor.width - 1, MATCHED_COLUMNS).round().long()
    parts = []
    for first in range(0, len(indices), _BATCH):
        range_m = scans.batch(indices[first : first + _BATCH]).range_m
        parts.append(torch.log2(1 + range_m[:, rows][:, :, columns]).flatten(1))
    return torch.cat(parts)
