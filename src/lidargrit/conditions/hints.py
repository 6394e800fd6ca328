"""Observed pixels → maps for a network that completes scans, and ranges to choose from, by classical methods."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64
from scipy.ndimage import uniform_filter1d
from torch import Tensor

from lidargrit.conditions import Condition
from lidargrit.conditions.fills import Observed, linear, triangles

NUM_MAPS, NUM_CANDIDATES = 19, 9
_LEFT_RIGHT = {7: 8, 8: 7, 11: 12, 12: 11}  # maps that change places in the mirror, and so do candidates:
_LEFT_RIGHT_CANDIDATES = {5: 6, 6: 5}
_TYPICAL_V = 2.5  # ln(1 + 11 m), the middle of what scans hold, so that maps are near 0
_FAR_PIXELS, _FARTHEST = 16.0, 4.0  # a distance is told in units of 16 pixels, up to 64 of them
_WINDOW = 9  # rows and columns in which shares are counted


class Hints(NamedTuple):
    """Inputs of a completion network from classical methods, for every pixel; ranges are ln(1 + range in metres).

    Args:
        maps: inputs of a network for every pixel: whether it was observed, returned or dropped; ln(1 + range) by
            triangulation, and the differences from it of the nearest return, of the next return above, below, to the
            left and to the right, and of the triangle's second and third corner; distances to those next returns;
            weights of those corners; shares of observed and of dropped pixels around it.
        candidates: candidates for ln(1 + range): by triangulation, by interpolation, of the nearest return, of the next
            return above, below, to the left and to the right, and of the triangle's second and third corner.
    """

    maps: Float[Tensor, "B 19 H W"]
    candidates: Float[Tensor, "B 9 H W"]

    def mirrored(self) -> Hints:
        """Return the hints of the scans' mirror images, left and right exchanged."""
        maps = [_LEFT_RIGHT.get(index, index) for index in range(NUM_MAPS)]
        candidates = [_LEFT_RIGHT_CANDIDATES.get(index, index) for index in range(NUM_CANDIDATES)]
        return Hints(self.maps[:, maps].flip(-1), self.candidates[:, candidates].flip(-1))


def hints_of(condition: Condition) -> Hints:
    """Return the hints of a batch of scans, on the device of the condition."""
    both = [_of_one(Observed.of(condition, index)) for index in range(len(condition))]
    maps, candidates = (torch.from_numpy(np.stack(part)).to(condition.range_m) for part in zip(*both, strict=True))
    return Hints(maps, candidates)


def _of_one(seen: Observed) -> tuple[Float32[np.ndarray, "19 H W"], Float32[np.ndarray, "9 H W"]]:
    if not seen.returned.any():
        empty = np.zeros((NUM_MAPS, *seen.returned.shape), dtype=np.float32)
        empty[0] = seen.observed
        return empty, np.full((NUM_CANDIDATES, *seen.returned.shape), _TYPICAL_V, dtype=np.float32)
    tiling = triangles(seen)
    filled, lines, near = (np.log1p(part) for part in (tiling.range_m, linear(seen), seen.nearest_range_m))
    corners = np.log1p(tiling.corners_m[1:])
    next_v, distances = zip(
        *(_next_return(seen, down, right) for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1))), strict=True
    )
    next_v = [np.where(np.isnan(v), filled, v) for v in next_v]
    drops = seen.observed & ~seen.returned
    share_observed, share_dropped = _share_around(seen.observed), _share_around(drops)
    maps = [
        seen.observed,
        seen.returned,
        drops,
        near - filled,
        filled - _TYPICAL_V,
        *(v - filled for v in next_v),
        *distances,
        share_dropped / np.maximum(share_observed, 1e-6),
        share_observed,
        *(corners - filled),
        *tiling.weights[1:],
    ]
    return np.stack(maps).astype(np.float32), np.stack([filled, lines, near, *next_v, *corners]).astype(np.float32)


def _share_around(part: Bool[np.ndarray, "H W"]) -> Float64[np.ndarray, "H W"]:
    """Return for every pixel the share of marked pixels in a window around it; columns wrap around."""
    down = uniform_filter1d(part.astype(np.float64), _WINDOW, 0, mode="constant")
    return uniform_filter1d(down, _WINDOW, 1, mode="wrap")


def _next_return(
    seen: Observed, down: int, right: int
) -> tuple[Float64[np.ndarray, "H W"], Float64[np.ndarray, "H W"]]:
    """Return ln(1 + range) of the next observed return on one side, NaN without one, and its distance."""
    lines = np.tile(seen.range_m, (1, 3)) if right else seen.range_m.T
    backwards = down + right < 0
    lines = lines if backwards else lines[:, ::-1]
    index = np.arange(lines.shape[1])
    last = np.maximum.accumulate(np.where(lines > 0, index, -1), axis=1)
    last = np.concatenate((np.full((len(lines), 1), -1), last[:, :-1]), axis=1)  # not the pixel itself
    range_m = np.where(last >= 0, np.take_along_axis(lines, np.maximum(last, 0), axis=1), np.nan)
    away = np.where(last >= 0, np.minimum((index - last) / _FAR_PIXELS, _FARTHEST), _FARTHEST)
    width = seen.range_m.shape[1]
    v, away = (part if backwards else part[:, ::-1] for part in (np.log1p(range_m), away))
    middle = slice(width, 2 * width)
    return (v[:, middle], away[:, middle]) if right else (v.T, away.T)
