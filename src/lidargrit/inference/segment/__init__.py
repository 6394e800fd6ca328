"""A segmenter and range images → their labels, also where the images have more columns than the segmenter's sensor."""

import itertools
import math
from operator import itemgetter

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from lidargrit.core.errors import ConfigError
from lidargrit.data.run_folder import locate
from lidargrit.generation.batches import check_images, one_by_one
from lidargrit.generation.generator import load
from lidargrit.generation.semantic_classes import NUM_CLASSES, labels_of
from lidargrit.nn.convolution import wrapped
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.systems.segmenter.system import Segmenter

_SAME_ROW_RAD = math.radians(0.01)
_SAME_SURFACE_M, _SAME_SURFACE_PER_RANGE = 0.2, 0.02  # returns of a surface differ in range by at most this


def open_segmenter(word: str, device: str = "") -> Segmenter:
    """Return the segmenter that a user named; of a bundle, the run that labels scans.

    Args:
        word: folder of a run or of a bundle, or ``pretrained``.
    """
    folder, wanted = locate(word, "segment"), "a segmenter's run, or pretrained"
    if not folder.exists():
        raise ConfigError(f"--model {word}, which does not exist", wanted, "check the name")
    generator = load(folder, device=device)
    if not isinstance(generator, Segmenter):
        got = f"--model {word}, of a generator {generator.public_name()!r}, which labels no scans"
        raise ConfigError(got, wanted, "train one with: lidargrit train segmenter_compact RUN, and name its folder")
    return generator


def can_label(own: SensorModel, sensor: SensorModel) -> bool:
    """Return whether a segmenter of one sensor can label images of another: of its rows, and n times its columns."""
    if own.height != sensor.height or sensor.width % own.width:
        return False
    rows = [each.elevation_rad.double().mean(1) for each in (own, sensor)]
    return torch.allclose(*rows, rtol=0, atol=_SAME_ROW_RAD)


def label_images(segmenter: Segmenter, images: RangeImage) -> RangeImage:
    """Return images with the likeliest class of each return as its label, in the computer's memory.

    Args:
        segmenter: segmenter of a run.
        images: batch of range images (B, H, W) for which :func:`can_label` holds.
    """
    check_images(images, images.sensor)
    label = torch.cat([labels_of(class_probabilities(segmenter, image).argmax(1) + 1) for image in one_by_one(images)])
    images = images.to("cpu")
    return images.with_planes(label=torch.where(images.return_mask, label, 0))


def class_probabilities(segmenter: Segmenter, image: RangeImage) -> Float[Tensor, "1 19 H W"]:
    """Return the probability of each of the benchmark's classes at every return, in the computer's memory.

    Of n times the segmenter's columns every n-th make an image that it knows: n such images are labelled one by one.
    A segmenter does not see at which azimuth a column lies, so it does not matter at which the first one does. Then
    all n vote on each return: it gets the mean over the returns of about its range in its row, the one above and the
    one below, in its column and the n // 2 to either side. A pixel without a return has any values.

    Args:
        segmenter: segmenter of a run.
        image: batch of one range image for which :func:`can_label` holds.
    """
    steps = image.sensor.width // segmenter.sensor.width
    of_class = torch.zeros(1, NUM_CLASSES, image.sensor.height, image.sensor.width)
    for first in range(steps):
        part = (..., slice(first, None, steps))
        some = image.mapped(itemgetter(part), segmenter.sensor)
        of_class[part] = segmenter.probabilities(some).cpu()
    return of_class if steps == 1 else _mean_over_surface(of_class, image.range_m.cpu(), 1, steps // 2)


def _mean_over_surface(
    of_class: Float[Tensor, "B C H W"], range_m: Float[Tensor, "B H W"], rows: int, columns: int
) -> Float[Tensor, "B C H W"]:
    """Return the mean of values over the neighbours of each return that lie about as far away, itself among them.

    Args:
        of_class: values of every pixel.
        range_m: range of the returns, 0 where nothing returned.
        rows: number of rows above and below that count.
        columns: number of columns to either side that count; the last column is beside the first.
    """
    total, count = torch.zeros_like(of_class), torch.zeros_like(range_m)
    border = (0, 0, rows, rows)  # of zeros above and below
    around_m, values = (F.pad(wrapped(each, columns, columns), border) for each in (range_m[:, None], of_class))
    within_m = _SAME_SURFACE_M + _SAME_SURFACE_PER_RANGE * range_m
    height, width = range_m.shape[-2:]
    for row, column in itertools.product(range(2 * rows + 1), range(2 * columns + 1)):
        window = (..., slice(row, row + height), slice(column, column + width))
        other_m = around_m[window][:, 0]
        same = ((other_m > 0) & ((other_m - range_m).abs() < within_m)).to(of_class.dtype)
        total.addcmul_(values[window], same[:, None])
        count += same
    return total / count.clamp(min=1)[:, None]
