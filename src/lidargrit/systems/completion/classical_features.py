"""Observed pixels → maps for a network that completes scans, and ranges to choose from, by classical methods."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int, Int64, Shaped
from scipy.ndimage import uniform_filter1d
from torch import Tensor

from lidargrit.scans.condition import Observed
from lidargrit.scans.fills import SeenScan, linear
from lidargrit.scans.types import TYPICAL_LOG_RANGE

NUM_MAPS, NUM_CANDIDATES, NUM_LABELS, NUM_REFLECTANCES = 19, 9, 5, 6
LABELLED = slice(2, 7)  # candidates that are the range of one return, whose label is known, too
REFLECTING = [0, 2, 3, 4, 5, 6]  # candidates of which the reflectance is known, too: by triangulation, and those
_LEFT_RIGHT = {7: 8, 8: 7, 11: 12, 12: 11}  # maps that change places in the mirror, and so do candidates:
_LEFT_RIGHT_CANDIDATES = {5: 6, 6: 5}
_LEFT_RIGHT_LABELS = [0, 1, 2, 4, 3]
_LEFT_RIGHT_REFLECTANCES = [0, 1, 2, 3, 5, 4]
_SIDES = ((-1, 0), (1, 0), (0, -1), (0, 1))  # rows down and columns to the right of each side
_FAR_PIXELS, _FARTHEST = 16.0, 4.0  # a distance is told in units of 16 pixels, up to 64 of them
_WINDOW = 9  # rows and columns in which shares are counted


class ClassicalFeatures(NamedTuple):
    """Inputs of a completion network from classical methods, for every pixel; ranges are ln(1 + range in metres).

    Args:
        maps: inputs of a network for every pixel, in this order: whether it was observed, returned, dropped; the
            nearest return minus triangulation; triangulation minus 2.5; the next returns above, below, to the left and
            to the right minus triangulation; distances to those four; the share of drops among observed pixels around
            it, and the share of observed ones; the triangle's second and third corner minus triangulation; their
            weights.
        candidates: candidates for ln(1 + range): by triangulation, by interpolation, of the nearest return, of the next
            return above, below, to the left and to the right, and of the triangle's second and third corner.
        labels: classes of the nearest return, and of the next return above, below, to the left and to the right, by
            SemanticKITTI's numbers; None without observed classes.
        reflectances: reflectance by triangulation, then of the returns of which labels tells the class; None without
            observed reflectance.
    """

    maps: Float[Tensor, "B 19 H W"]
    candidates: Float[Tensor, "B 9 H W"]
    labels: Int[Tensor, "B 5 H W"] | None = None
    reflectances: Float[Tensor, "B 6 H W"] | None = None

    def mapped(self, function: Callable[[Tensor], Tensor]) -> "ClassicalFeatures":
        """Return the features with a function applied to the maps of each."""
        labels, reflectances = (None if each is None else function(each) for each in (self.labels, self.reflectances))
        return ClassicalFeatures(function(self.maps), function(self.candidates), labels, reflectances)

    def mirrored(self) -> "ClassicalFeatures":
        """Return the classical features of the scans' mirror images, left and right exchanged."""
        maps = [_LEFT_RIGHT.get(index, index) for index in range(NUM_MAPS)]
        candidates = [_LEFT_RIGHT_CANDIDATES.get(index, index) for index in range(NUM_CANDIDATES)]
        labels = None if self.labels is None else self.labels[:, _LEFT_RIGHT_LABELS].flip(-1)
        bright = None if self.reflectances is None else self.reflectances[:, _LEFT_RIGHT_REFLECTANCES].flip(-1)
        return ClassicalFeatures(self.maps[:, maps].flip(-1), self.candidates[:, candidates].flip(-1), labels, bright)


def classical_features(condition: Observed, device: torch.device | None = None) -> ClassicalFeatures:
    """Return the classical features of a batch of scans, on a device; on that of the condition if none is given."""
    device, dtype = condition.range_m.device if device is None else device, condition.range_m.dtype
    every = [SeenScan.of(condition, index) for index in range(len(condition))]
    next_returns = [[_next_return(seen, *side) for side in _SIDES] for seen in every]
    both = [_of_one(seen, nexts) for seen, nexts in zip(every, next_returns, strict=True)]
    maps, candidates = (torch.from_numpy(np.stack(part)).to(device, dtype) for part in zip(*both, strict=True))
    labels, reflectances = [], []
    for index, (seen, nexts) in enumerate(zip(every, next_returns, strict=True)):
        if condition.label is not None:
            labels.append(_at_returns(condition.label[index].cpu().numpy(), seen, nexts))
        if condition.reflectance is not None:
            pixels = condition.reflectance[index].cpu().numpy()
            interpolated = seen.triangles.weighed(pixels) if seen.returned.any() else np.zeros_like(pixels)
            reflectances.append(np.stack((interpolated, *_at_returns(pixels, seen, nexts))))
    of_labels, of_reflectance = (
        torch.from_numpy(np.stack(found)).to(device) if found else None for found in (labels, reflectances)
    )
    return ClassicalFeatures(maps, candidates, of_labels, of_reflectance)


class _NextReturn(NamedTuple):
    """The next observed return on one side of every pixel.

    Args:
        pixel: index of the return among all pixels, row by row; -1 without one.
        away: distance to the return, in units of 16 pixels.
    """

    pixel: Int64[np.ndarray, "H W"]
    away: Float64[np.ndarray, "H W"]


def _of_one(
    seen: SeenScan, next_returns: Sequence[_NextReturn]
) -> tuple[Float32[np.ndarray, "19 H W"], Float32[np.ndarray, "9 H W"]]:
    if not seen.returned.any():
        empty = np.zeros((NUM_MAPS, *seen.returned.shape), dtype=np.float32)
        empty[0] = seen.observed
        return empty, np.full((NUM_CANDIDATES, *seen.returned.shape), TYPICAL_LOG_RANGE, dtype=np.float32)
    tiling = seen.triangles
    filled, lines, near = (np.log1p(part) for part in (tiling.range_m, linear(seen), seen.nearest_range_m))
    corners = np.log1p(tiling.corners_m[1:])
    observed_v = np.log1p(seen.range_m).ravel()
    next_v = [np.where(found.pixel < 0, filled, observed_v[found.pixel]) for found in next_returns]
    drops = seen.observed & ~seen.returned
    share_observed, share_dropped = _share_around(seen.observed), _share_around(drops)
    maps = [
        seen.observed,
        seen.returned,
        drops,
        near - filled,
        filled - TYPICAL_LOG_RANGE,
        *(v - filled for v in next_v),
        *(found.away for found in next_returns),
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


def _at_returns(
    pixels: Shaped[np.ndarray, "H W"], seen: SeenScan, next_returns: Sequence[_NextReturn]
) -> Shaped[np.ndarray, "5 H W"]:
    """Return what pixels hold at the nearest return and at those on every side; at the nearest where there is none.

    Without any return all is 0.
    """
    if not seen.returned.any():
        return np.zeros((1 + len(next_returns), *pixels.shape), dtype=pixels.dtype)
    nearest = pixels[seen.nearest_return]
    return np.stack([nearest, *(np.where(at < 0, nearest, pixels.ravel()[at]) for at, _ in next_returns)])


def _next_return(seen: SeenScan, down: int, right: int) -> _NextReturn:
    """Return the next observed return on one side of every pixel, not the pixel itself; columns wrap around."""
    lines = np.tile(seen.range_m, (1, 3)) if right else seen.range_m.T
    backwards = down + right < 0
    lines = lines if backwards else lines[:, ::-1]
    index = np.arange(lines.shape[1])
    last = np.maximum.accumulate(np.where(lines > 0, index, -1), axis=1)
    last = np.concatenate((np.full((len(lines), 1), -1), last[:, :-1]), axis=1)  # not the pixel itself
    away = np.where(last >= 0, np.minimum((index - last) / _FAR_PIXELS, _FARTHEST), _FARTHEST)
    at = last if backwards else np.where(last >= 0, len(index) - 1 - last, -1)
    at, away = (part if backwards else part[:, ::-1] for part in (at, away))
    width = seen.range_m.shape[1]
    line = np.arange(len(lines))[:, None]
    if not right:
        return _NextReturn(np.where(at >= 0, at * width + line, -1).T, away.T)
    middle = slice(width, 2 * width)
    return _NextReturn(np.where(at >= 0, line * width + at % width, -1)[:, middle], away[:, middle])
