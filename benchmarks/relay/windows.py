"""Windows of labelled vehicles → how much of them is open in what was made of these images."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool
from scipy import ndimage

from lidargrit.core.errors import ConfigError
from lidargrit.scans.classes import CLASSES
from lidargrit.scans.types import RangeImage

_VEHICLES = [number for number, of_class in CLASSES.items() if of_class.group == "vehicle"]
_LEAST_PIXELS, _LEAST_WINDOW = 40, 6
_RELATIVE_ERROR = 0.05
_TOUCHING = np.ones((3, 3))  # pixels that share a corner belong together


class Windows(NamedTuple):
    """How much of vehicles' windows, through which rays are lost, is open in made images.

    Args:
        overlap: mean over vehicles of the intersection over union of the open pixels, in [0, 1]; NaN without vehicles.
        half: vehicles whose windows overlap by half or more.
        total: vehicles with windows in the true images.
        share_of_pixels: share of the pixels of all vehicles with a range within 5 % of the true one; NaN without any.
    """

    overlap: float
    half: int
    total: int
    share_of_pixels: float


def kept_windows(truth: RangeImage, made: RangeImage) -> Windows:
    """Compare the windows of each vehicle: at least 6 connected drops between the ends of its columns.

    A vehicle is a connected set of at least 40 labelled pixels, and its columns end at its highest and lowest one. A
    vehicle that lies across the first and the last column counts as two.

    Args:
        truth: batch of range images with labels.
        made: images made of them, of the same size and order; only their ranges and returns are read.
    """
    if truth.label is None:
        raise ConfigError("range images without labels", "labelled ones, such as simulated streets", "give those")
    vehicles = np.isin(truth.label.cpu().numpy(), _VEHICLES) & truth.return_mask.cpu().numpy()
    true_m, made_m = (images.range_m.cpu().numpy() for images in (truth, made))
    true_drops, made_drops = (~images.return_mask.cpu().numpy() for images in (truth, made))
    close = (np.abs(made_m - true_m) <= _RELATIVE_ERROR * true_m) & ~made_drops
    pairs = [
        (_windows(true & outline), _windows(made & outline))
        for vehicle, true, made in zip(vehicles, true_drops, made_drops, strict=True)
        for outline in _outlines(vehicle)
    ]
    overlaps = [float((before & after).sum() / (before | after).sum()) for before, after in pairs if before.any()]
    mean = float(np.mean(overlaps)) if overlaps else float("nan")
    share = float(close[vehicles].mean()) if vehicles.any() else float("nan")
    return Windows(mean, sum(overlap >= 0.5 for overlap in overlaps), len(overlaps), share)


def _outlines(vehicles: Bool[np.ndarray, "H W"]) -> list[Bool[np.ndarray, "H W"]]:
    """Return all pixels of each vehicle, also those between two of its own in the same column."""
    numbered, count = ndimage.label(vehicles, _TOUCHING)
    each = [numbered == number for number in range(1, count + 1)]
    return [_below_first(one) & _below_first(one[::-1])[::-1] for one in each if one.sum() >= _LEAST_PIXELS]


def _below_first(pixels: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    return np.logical_or.accumulate(pixels, axis=0)


def _windows(drops: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Return the drops that are connected with enough others; the rest are lost by chance."""
    numbered, _ = ndimage.label(drops, _TOUCHING)
    return drops & (np.bincount(numbered.ravel())[numbered] >= _LEAST_WINDOW)
