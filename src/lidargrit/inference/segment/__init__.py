"""A segmenter and range images → their labels, also where the images have more columns than the segmenter's sensor."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch

from lidargrit.generation.generator import Generator
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage

_SAME_ROW_RAD = math.radians(0.01)


def can_label(own: SensorModel, sensor: SensorModel) -> bool:
    """Return whether a segmenter of one sensor can label images of another: of its rows, and n times its columns.

    Args:
        own: sensor of the segmenter.
        sensor: sensor of the images.
    """
    if own.height != sensor.height or sensor.width % own.width:
        return False
    rows = [each.elevation_rad.double().mean(1) for each in (own, sensor)]
    return torch.allclose(*rows, rtol=0, atol=_SAME_ROW_RAD)


def label_images(segmenter: Generator[Any, Any], images: RangeImage) -> RangeImage:
    """Return images with labels, in the computer's memory.

    Of n times the segmenter's columns every n-th make an image that it knows: n such images are labelled one by one.
    A segmenter does not see at which azimuth a column lies, so it does not matter at which the first one does.

    Args:
        segmenter: generator that labels scans.
        images: batch of range images (B, H, W) for which :func:`can_label` holds.
    """
    steps = images.sensor.width // segmenter.sensor.width
    label = torch.zeros(images.range_m.shape, dtype=torch.int64)
    for first in range(steps):
        some = RangeImage(
            images.range_m[..., first::steps],
            images.return_mask[..., first::steps],
            segmenter.sensor,
            None if images.reflectance is None else images.reflectance[..., first::steps],
        )
        found = segmenter.segment(some).label
        assert found is not None
        label[..., first::steps] = found.cpu()
    return replace(images.to("cpu"), label=label)
