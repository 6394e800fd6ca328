"""Where points lie in space, over a whole set: two sets → 3-D Jensen-Shannon divergence in a ball of grid points."""

from functools import cache
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from scipy.spatial import KDTree

from lidargrit.evaluation.metrics.shared.accumulators import SumAccumulator
from lidargrit.evaluation.metrics.shared.clouds import CloudMetric, Clouds
from lidargrit.evaluation.metrics.shared.curves import divergence

_SIDE = 28  # grid points along each axis, from -1 to 1 times the longest range
_EPSILON = 1e-8  # of the program, against the logarithm of 0


class PointCloudJsd(CloudMetric):
    """Compare the clouds of all scans of a set together, each point at the nearest point of a 28x28x28 grid.

    Of the grid only the 10,144 points within the longest range are used. The value is the Jensen-Shannon divergence in
    bits, from 0 to 1, not its root: the paper's "JSD" for KITTI odometry (times 100), another number than ``bev_jsd``.
    Scenes are not seen, only their sum; only the sum is kept.

    Args:
        variant: published way to sample points from a scan, see :class:`CloudMetric`. Besides, ``reference`` adds
            1e-8 to every share of either set, and once more to their mean, as LidarGRIT's program does: a set against
            itself then gives about 0.0024 instead of 0, and sets that have nothing in common up to 1.0025.

    Source:
        Achlioptas et al., Learning representations and generative models for 3D point clouds, ICML 2018;
        hamedhaghighi/LidarGRIT@a3f86e7.
    """

    title = "Jensen-Shannon divergence of point clouds in space"
    bounds = (0.0, 1.0025)  # above 1 by ``reference`` alone
    of_equal_sets: ClassVar = {"reference": "its program adds 1e-8 to every share"}
    fewest_images = 1
    accumulator = SumAccumulator

    def summarise(self, features: Clouds, *, real: bool) -> Int64[np.ndarray, "grid"]:
        """Count the points of a batch at every grid point."""
        return grid_counts(features.reshape(-1, 3))

    def compare(
        self, generated: Int64[np.ndarray, "grid"], real: Int64[np.ndarray, "grid"]
    ) -> tuple[float, dict[str, Any]]:
        """Return the divergence in bits."""
        if self.variant == "reference":
            return divergence_with_epsilon(generated, real), {}
        return float(divergence(generated, real)), {}


def grid_counts(points: Float32[np.ndarray, "n 3"]) -> Int64[np.ndarray, "grid"]:
    """Count points at the nearest of the grid points, in the order of x, y, z.

    Rounding each coordinate finds it at once, unless that lies outside the ball; then a tree is asked. A coordinate
    half way between two goes to the lower one.

    Args:
        points: points (n, 3) in units of the longest range.
    """
    inside, number, tree = _grid()
    position = (points.astype(np.float64) + 1) * ((_SIDE - 1) / 2)
    nearest = np.ceil(position - 0.5).clip(0, _SIDE - 1).astype(np.int64)
    found = number[nearest[:, 0], nearest[:, 1], nearest[:, 2]]
    rim = found < 0
    found[rim] = tree.query(position[rim])[1]
    return np.bincount(found, minlength=int(inside.sum()))


@cache
def _grid() -> tuple[Bool[np.ndarray, "28 28 28"], Int64[np.ndarray, "28 28 28"], KDTree]:
    """Return which points of the cube are in the ball, their numbers (-1 outside), and a tree of them."""
    odd = 2 * np.arange(_SIDE) - (_SIDE - 1)  # coordinates in 27ths: whole numbers, so that the border is exact
    inside = odd[:, None, None] ** 2 + odd[:, None] ** 2 + odd**2 <= (_SIDE - 1) ** 2
    number = np.where(inside, inside.ravel().cumsum().reshape(inside.shape) - 1, -1)
    return inside, number, KDTree(np.argwhere(inside))


def divergence_with_epsilon(first: Int64[np.ndarray, "grid"], second: Int64[np.ndarray, "grid"]) -> float:
    """Return the divergence in bits as LidarGRIT's program has it: 1e-8 added to the shares and again to the mean."""
    p, q = (counts / counts.sum() + _EPSILON for counts in (first, second))
    return entropy((p + q) / 2 + _EPSILON) - (entropy(p) + entropy(q)) / 2


def entropy(shares: Float64[np.ndarray, "grid"]) -> float:
    """Return the entropy in bits."""
    return float(-(shares * np.log2(shares)).sum())
