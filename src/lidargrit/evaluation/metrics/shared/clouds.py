"""Range images → clouds of 512 points that lie far from one another, in units of the sensor's longest range."""

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float32, Int64

from lidargrit.evaluation.metrics import FeatureExtractor, Metric
from lidargrit.evaluation.metrics.shared.accumulators import Accumulator, RowAccumulator
from lidargrit.evaluation.metrics.shared.farthest_points import farthest_points
from lidargrit.scans.projection import points_of_pixels
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage

POINTS = 512  # per cloud, as in LidarGRIT's program; DUSty's paper has 2048, its training 512
_NEAREST_SQUARED = np.float32(1e-3)  # LidarGRIT's kernel never chooses a point this near: 2.5 m of 80, 3.8 m of 120

Clouds = Float32[np.ndarray, "n points 3"]


@dataclass(frozen=True)
class FarthestPointClouds(FeatureExtractor[Clouds]):
    """512 points of every scan that lie far from one another, divided by the sensor's longest range.

    Args:
        variant: published definition of the sampling, see :class:`CloudMetric`.
    """

    variant: str

    def __call__(self, images: RangeImage) -> Clouds:
        """Return the cloud of every scan."""
        points = points_of_pixels(images).float().flatten(1, 2) / images.sensor.range_max_m
        return sampled_clouds(points.numpy(), self.variant)


class CloudMetric(Metric[Clouds, np.ndarray]):
    """Compares sets of clouds: of every scan, 512 points that lie far from one another, divided by the longest range.

    The variant says which points those are. ``exact``: sampling begins with the return farthest from the sensor, and
    only returns are chosen; of a scan with fewer than 512 returns all are taken, in turn until there are 512; a scan
    without any return is 512 times the origin. ``reference`` is LidarGRIT's program: sampling begins with the first
    pixel, which is mostly empty and then adds the origin to the cloud; points closer to the sensor than
    sqrt(0.001) = 0.032 of the longest range are never chosen; of equally far points the one with the smallest
    bit-reversed index comes first; indices repeat if there are too few. A cloud takes 6 kB.
    """

    variants = ("exact", "reference")
    accumulator: type[Accumulator[np.ndarray]] = RowAccumulator

    @final
    def extractor(self, sensor: SensorModel) -> FarthestPointClouds:
        """Return what samples points."""
        return FarthestPointClouds(self.variant)

    def summarise(self, features: Clouds, *, real: bool) -> np.ndarray:
        """Return the clouds themselves."""
        return features


def sampled_clouds(points: Float32[np.ndarray, "n pixels 3"], variant: str) -> Clouds:
    """Choose 512 points of every scan; points at the origin are no returns.

    Args:
        points: points of all pixels, in units of the longest range.
    """
    squared = np.square(points[..., 0]) + np.square(points[..., 1]) + np.square(points[..., 2])
    if variant == "reference":
        chosen = farthest_points(points, squared > _NEAREST_SQUARED, POINTS, 0, bits_reversed(points.shape[1]))
    else:
        returned = squared > 0
        chosen = farthest_points(points, returned, POINTS)
        turn = np.arange(POINTS) % np.clip(returned.sum(axis=1, keepdims=True), 1, POINTS)
        chosen = np.take_along_axis(chosen, turn, axis=1)
    return np.take_along_axis(points, chosen[..., None], axis=1)


def bits_reversed(n: int) -> Int64[np.ndarray, "{n}"]:
    """Return the order in which LidarGRIT's kernel takes equally far points: the tree of its 512 threads decides."""
    index = np.arange(n)
    thread = index % POINTS
    reverse = np.sum([(thread >> bit & 1) << 8 - bit for bit in range(9)], axis=0)
    return np.lexsort((index, reverse))
