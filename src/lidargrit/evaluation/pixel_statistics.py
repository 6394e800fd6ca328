"""Real scans → scans of pixel statistics: each pixel is that of another scan, so that no shape is left."""

from collections.abc import Iterator, Sequence

import torch

from lidargrit.evaluation.pairs import EvalSet
from lidargrit.scans.types import RangeImage

_PIXELS_AT_ONCE = 1 << 24  # shuffled in memory: 1,024 scans of 64x256


def pixel_statistics(scans: EvalSet, indices: Sequence[int], seed: int) -> Iterator[RangeImage]:
    """Shuffle each pixel among scans, independently of all other pixels; range, return and reflectance stay together.

    Nothing is drawn twice: each pixel has exactly the values that it has in the scans, so that sets of independent
    pixels score alike before and after.

    Args:
        scans: set that holds the scans.
        indices: numbers of the scans to shuffle, at least two.

    Yields:
        batches of scans, as many in all as there are indices. Where they do not fit into memory at once, each batch
        has scans from all over the set.
    """
    sensor = scans.images.sensor
    at_once = max(2, _PIXELS_AT_ONCE // (sensor.height * sensor.width))
    batches = max(1, len(indices) // at_once)
    rng = torch.Generator().manual_seed(seed)
    for first in range(batches):
        images = scans.batch(indices[first::batches])
        order = torch.rand(images.range_m.shape, generator=rng).argsort(dim=0)
        yield images.mapped(lambda pixels: pixels.gather(0, order))  # noqa: B023 - called at once
