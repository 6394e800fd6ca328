"""Accuracy of the nearest neighbour (1-NNA) at telling generated clouds from real ones; 0.5 is the best."""

from typing import Any

import numpy as np

from lidargrit.evaluation.metrics.shared.clouds import CloudMetric
from lidargrit.evaluation.metrics.shared.matching import Clouds, nearest_between, nearest_within


class OneNearestNeighbour(CloudMetric):
    """Guess the set of every scan from its nearest neighbour among all others; the value is the share of right guesses.

    Known as 1-NNA. Two sets of one kind give 0.5, the best; sets that can be told apart give up to 1. So lower is
    better, down to 0.5. A value well below 0.5 is no better still: it says that generated scans are nearer to single
    real ones than these are to one another, that is, copies; a set against itself gives 0. The details hold
    ``from_half``, the distance from 0.5, and the accuracy on both sets alone: if that of ``real`` is far below that of
    ``generated``, the generated scans are of few kinds.
    A scan that is equally far from both sets counts as half a right guess. Which scans are nearest is decided in single
    precision, up to 1e-6; which of the two sets is nearer, in double. Time grows with the square of the
    number of scans.

    Args:
        variant: published way to sample points from a scan, see :class:`CloudMetric`.

    Source:
        Lopez-Paz and Oquab, Revisiting classifier two-sample tests, ICLR 2017; Yang et al., PointFlow, ICCV 2019;
        hamedhaghighi/LidarGRIT@a3f86e7.
    """

    title = "Accuracy of telling the sets of point clouds by nearest neighbour (0.5 is best)"
    bounds = (0.0, 1.0)

    def compare(self, generated: Clouds, real: Clouds) -> tuple[float, dict[str, Any]]:
        """Return the accuracy over both sets, and that of each in the details."""
        right = []
        for across, clouds in zip(nearest_between(real, generated), (real, generated), strict=True):
            within = nearest_within(clouds)
            right.append((within.distance < across.distance) + 0.5 * (within.distance == across.distance))
        value = float(np.concatenate(right).mean())
        details = {"from_half": abs(value - 0.5), "real": float(right[0].mean()), "generated": float(right[1].mean())}
        return value, details
