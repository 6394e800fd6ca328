"""Poles and trunks of labelled range images → how many of them still stand in what was made of these images."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Int
from scipy import ndimage

from lidargrit.core.errors import ConfigError
from lidargrit.scans.types import RangeImage

_TRUNK, _POLE = 71, 80  # SemanticKITTI's numbers
_LEAST_PIXELS = 40  # of 1024 columns
_RELATIVE_ERROR, _LEAST_SHARE = 0.05, 0.6
_TOUCHING = np.ones((3, 3))  # pixels that share a corner belong together


class Kept(NamedTuple):
    """Number of upright objects that still stand, and of all.

    Args:
        kept: objects of whose pixels at least six tenths have a range within 5 % of the true one.
        total: objects of the true images.
        share_of_pixels: mean share of an object's pixels whose range is within 5 %, in [0, 1]; NaN without objects.
    """

    kept: int
    total: int
    share_of_pixels: float


def upright_objects(images: RangeImage, least_pixels: int = _LEAST_PIXELS) -> Int[np.ndarray, "B H W"]:
    """Number the poles and trunks of each image from 1; other pixels are 0.

    An object is a connected set of at least so many pixels labelled as pole or trunk that spans at least twice as many
    rows as columns. One that lies across the first and the last column counts as two.
    """
    if images.label is None:
        raise ConfigError("range images without labels", "labelled ones, such as simulated streets", "give those")
    upright = np.isin(images.label.cpu().numpy(), (_TRUNK, _POLE)) & images.return_mask.cpu().numpy()
    numbers = np.zeros(upright.shape, np.int64)
    for mask, numbered in zip(upright, numbers, strict=True):
        components = np.zeros(mask.shape, np.int64)
        ndimage.label(mask, _TOUCHING, components)
        count = 0
        for index, box in enumerate(ndimage.find_objects(components), 1):
            found = components[box] == index
            if found.sum() >= least_pixels and found.any(1).sum() >= 2 * found.any(0).sum():
                count += 1
                numbered[box][found] = count
    return numbers


def kept_objects(truth: RangeImage, made: RangeImage, least_pixels: int = _LEAST_PIXELS) -> Kept:
    """Count the poles and trunks of labelled images that stand in reconstructions, or in samples from true tokens.

    Args:
        truth: batch of range images with labels.
        made: images made of them, of the same size and order; only their ranges and returns are read.
        least_pixels: number of pixels of the smallest object that counts.
    """
    numbers = upright_objects(truth, least_pixels)
    true_m, made_m = (images.range_m.cpu() for images in (truth, made))
    close = ((made_m - true_m).abs() <= _RELATIVE_ERROR * true_m) & made.return_mask.cpu()
    shares = [
        float(within[torch.from_numpy(numbered == number)].float().mean())
        for numbered, within in zip(numbers, close, strict=True)
        for number in range(1, int(numbered.max()) + 1)
    ]
    mean = float(np.mean(shares)) if shares else float("nan")
    return Kept(sum(share >= _LEAST_SHARE for share in shares), len(shares), mean)
