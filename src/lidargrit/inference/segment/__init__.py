"""A segmenter and range images → their labels, also where the images have more columns than the segmenter's sensor."""

import math
from operator import itemgetter

import torch

from lidargrit.core.errors import ConfigError
from lidargrit.data.run_folder import locate
from lidargrit.generation.generator import load
from lidargrit.nn.devices import usable_device
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.systems.segmenter.system import Segmenter

_SAME_ROW_RAD = math.radians(0.01)


def open_segmenter(word: str, device: str = "") -> Segmenter:
    """Return the segmenter that a user named; of a bundle, the run that labels scans.

    Args:
        word: folder of a run or of a bundle, or ``pretrained``.
    """
    folder, wanted = locate(word, "segment"), "a segmenter's run, or pretrained"
    if not folder.exists():
        raise ConfigError(f"--model {word}, which does not exist", wanted, "check the name")
    generator = load(folder)
    if not isinstance(generator, Segmenter):
        got = f"--model {word}, of a generator {generator.public_name()!r}, which labels no scans"
        raise ConfigError(got, wanted, "train one with: lidargrit train segmenter_compact RUN, and name its folder")
    return generator.to(usable_device(device))


def can_label(own: SensorModel, sensor: SensorModel) -> bool:
    """Return whether a segmenter of one sensor can label images of another: of its rows, and n times its columns."""
    if own.height != sensor.height or sensor.width % own.width:
        return False
    rows = [each.elevation_rad.double().mean(1) for each in (own, sensor)]
    return torch.allclose(*rows, rtol=0, atol=_SAME_ROW_RAD)


def label_images(segmenter: Segmenter, images: RangeImage) -> RangeImage:
    """Return images with labels, in the computer's memory.

    Of n times the segmenter's columns every n-th make an image that it knows: n such images are labelled one by one.
    A segmenter does not see at which azimuth a column lies, so it does not matter at which the first one does.

    Args:
        segmenter: segmenter of a run.
        images: batch of range images (B, H, W) for which :func:`can_label` holds.
    """
    steps = images.sensor.width // segmenter.sensor.width
    label = torch.zeros(images.range_m.shape, dtype=torch.int64)
    for first in range(steps):
        part = (..., slice(first, None, steps))
        some = images.mapped(itemgetter(part), segmenter.sensor)
        found = segmenter.segment(some).label
        assert found is not None
        label[part] = found.cpu()
    return images.to("cpu").with_planes(label=label)
