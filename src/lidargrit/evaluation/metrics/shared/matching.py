"""Two sets of clouds → which cloud is nearest to which, by the Chamfer distance."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64
from scipy.spatial import KDTree
from torch import Tensor

Cloud = Float[np.ndarray, "_ 3"]
Clouds = Float32[np.ndarray, "_ points 3"]


@dataclass(frozen=True, eq=False)
class Nearest:
    """For every cloud of a set, the nearest of another set, or of its own set without itself."""

    index: Int64[np.ndarray, " n"]
    distance: Float64[np.ndarray, " n"]


def chamfer_distance(first: Cloud, second: Cloud) -> float:
    """Return the mean squared distance of the points of one cloud to the nearest of the other, both ways, added.

    In double precision and by differences of coordinates: equal clouds give 0.

    Source:
        As in Achlioptas et al., Learning representations and generative models for 3D point clouds, ICML 2018,
        but with means instead of sums, as LidarGRIT's program has it.
    """
    there, back = (KDTree(one).query(other)[0] for one, other in ((first, second), (second, first)))
    return float(np.square(there).mean() + np.square(back).mean())


def chamfer_matrix(first: Clouds, second: Clouds | None = None) -> Float32[np.ndarray, "n m"]:
    """Return the Chamfer distances of all pairs of clouds, or of all pairs of one set, infinite from each to itself.

    In single precision from |a|^2 + |b|^2 - 2ab, a product of matrices: fast, but of points within the unit sphere
    wrong by up to 1e-6, so only to decide which cloud is nearer.
    """
    left = [_factor(cloud, left=True) for cloud in first]
    right = [_factor(cloud, left=False) for cloud in (first if second is None else second)]
    matrix = np.full((len(left), len(right)), np.inf, dtype=np.float32)
    squared = torch.empty(first.shape[1], right[0].shape[1])
    for i, rows in enumerate(left):
        for j in range(i + 1 if second is None else 0, len(right)):
            torch.mm(rows, right[j], out=squared)
            matrix[i, j] = squared.amin(0).clamp_(min=0).mean() + squared.amin(1).clamp_(min=0).mean()
            if second is None:
                matrix[j, i] = matrix[i, j]
    return matrix


def _factor(cloud: Cloud, *, left: bool) -> Float32[Tensor, "_ _"]:
    """Return the rows [-2a, |a|^2, 1] or the columns [b, 1, |b|^2], whose products are squared distances."""
    points = torch.from_numpy(cloud)
    square, one = points.square().sum(1, keepdim=True), torch.ones(len(points), 1)
    return (
        torch.cat((-2 * points, square, one), dim=1) if left else torch.cat((points, one, square), dim=1).T.contiguous()
    )


def nearest_between(first: Clouds, second: Clouds) -> tuple[Nearest, Nearest]:
    """Return the nearest of the second set for each of the first, and the other way round."""
    matrix = chamfer_matrix(first, second)
    return _exactly(matrix.argmin(axis=1), first, second), _exactly(matrix.argmin(axis=0), second, first)


def nearest_within(clouds: Clouds) -> Nearest:
    """Return the nearest other cloud of the same set for each."""
    return _exactly(chamfer_matrix(clouds).argmin(axis=1), clouds, clouds)


def _exactly(index: Int64[np.ndarray, " n"], clouds: Clouds, others: Clouds) -> Nearest:
    distance = [chamfer_distance(cloud, others[near]) for cloud, near in zip(clouds, index, strict=True)]
    return Nearest(index, np.array(distance))
