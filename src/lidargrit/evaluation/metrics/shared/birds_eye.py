"""Points → counts seen from above: 1.6 m cells as each program of this field makes them, finer ones as LiDM's does."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor

from lidargrit.evaluation.metrics import FeatureExtractor
from lidargrit.evaluation.metrics.shared.curves import divergence
from lidargrit.scans.projection import points_of_pixels
from lidargrit.scans.types import RangeImage

# All from Zyrianov et al., LiDARGen, ECCV 2022, and its program, which the others follow.
_HALF_M = 80  # of the grid
CELLS = 100  # along each axis: 1.6 m wide
_NEAR_M, _FAR_M = 3.0, 70.0  # closer points are the car itself; no point within 70 m leaves the grid
_SHORT_M, _LONG_M = 0.5, 63.0  # LiDARGen's encoding ends at 2^6 - 1 m; R2DM leaves out what it cannot show
LIDM_HALF_M = 50  # of the grid of LiDM's toolbox for 64 rows: lidm/eval of hancyran/LiDAR-Diffusion@4c94f10

JSD_BOUNDS = 0.0, math.sqrt(math.log(2))  # of the root of the divergence in nats

Axis = Float32[np.ndarray, "n"]
Cell = Int64[np.ndarray, "n"]


def _exact(axis_m: Axis) -> Cell:
    """Cell k is 8/5 (k - 50) <= x < 8/5 (k - 49), with no rounding: five eighths of a float32 fit in 64 bits."""
    return np.floor(axis_m.astype(np.float64) * 0.625).astype(np.int64) + CELLS // 2


def _lidargrit(axis_m: Axis) -> Cell:
    """Single precision, cut off toward zero, clamped into the grid."""
    cell = ((axis_m + np.float32(_HALF_M)) / np.float32(2 * _HALF_M / CELLS)).astype(np.int64)
    return cell.clip(0, CELLS - 1)


def _r2dm(axis_m: Axis) -> Cell:
    """Between edges in single precision; the last cell has its right edge."""
    edges = torch.linspace(-_HALF_M, _HALF_M, CELLS + 1)
    cell = torch.bucketize(torch.from_numpy(np.ascontiguousarray(axis_m)), edges, right=True).numpy() - 1
    return cell - (axis_m == _HALF_M)


_CELL_OF: dict[str, Callable[[Axis], Cell]] = {
    "exact": _exact,
    "lidargrit": _lidargrit,
    "r2dm": _r2dm,
    "lidargen": _exact,  # NumPy's histogram has its edges in double precision
}
VARIANTS = tuple(_CELL_OF)


@dataclass(frozen=True)
class BirdsEyeHistograms(FeatureExtractor[Int64[np.ndarray, "B cells"]]):
    """The number of points of every scan in each cell of a grid of 100x100 cells, seen from above.

    Args:
        variant: published definition of the grid, one of ``VARIANTS``.
    """

    variant: str

    def __call__(self, images: RangeImage) -> Int64[np.ndarray, "B cells"]:
        """Return one row of 10,000 cells per scan."""
        return histograms(points_from_above(images, self.variant), self.variant)


def points_from_above(images: RangeImage, variant: str) -> Float[Tensor, "B n 3"]:
    """Return the points of a batch that a program would look at; those it leaves out lie at the origin."""
    points_xyz_m = points_of_pixels(images)
    range_m = images.range_m[..., None]
    if variant == "r2dm":
        points_xyz_m = torch.where((range_m > _SHORT_M) & (range_m < _LONG_M), points_xyz_m, 0.0)
    elif variant == "lidargen":
        points_xyz_m = torch.where(range_m > _LONG_M, points_xyz_m * (_LONG_M / range_m), points_xyz_m)
    return points_xyz_m.flatten(1, 2)


def histograms(points_xyz_m: Float[Tensor, "B n 3"], variant: str) -> Int64[np.ndarray, "B cells"]:
    """Count the points of every scan in the cells of the grid, those nearer than 3 m and beyond 70 m left out.

    Args:
        points_xyz_m: points in the sensor's frame, in metres.
        variant: one of ``VARIANTS``; they differ for points on the border of two cells only.

    Returns:
        the 100x100 cells in one row: cell 100 i + j is the i-th along x and the j-th along y.
    """
    points = points_xyz_m.float().numpy()
    squared = np.square(points[..., 0]) + np.square(points[..., 1]) + np.square(points[..., 2])
    range_m = np.sqrt(squared)
    scan, pixel = np.nonzero((range_m > _NEAR_M) & (range_m < _FAR_M))
    x, y = (_CELL_OF[variant](points[scan, pixel, axis]) for axis in (0, 1))
    cells = CELLS * CELLS
    return np.bincount(scan * cells + x * CELLS + y, minlength=len(points) * cells).reshape(-1, cells)


def occupied_cells(images: RangeImage, cells_per_m: int) -> Int64[np.ndarray, "cells"]:
    """Find the cells that hold a point of a scan, of LiDM's grid over +-50 m, whose border is outside.

    LiDM's toolbox finds cells in single precision, here nothing is rounded.

    Returns:
        every occupied cell once: (scan * side + cell along x) * side + cell along y.
    """
    points = points_of_pixels(images).float().numpy()[..., :2]
    inside = images.return_mask.numpy() & (np.abs(points) < LIDM_HALF_M).all(axis=-1)
    cells = 2 * LIDM_HALF_M * cells_per_m
    cell = np.floor(points[inside].astype(np.float64) * cells_per_m).astype(np.int64) + cells // 2
    return np.unique((np.nonzero(inside)[0] * cells + cell[:, 0]) * cells + cell[:, 1])


def jensen_shannon_distance(first: Int64[np.ndarray, "cells"], second: Int64[np.ndarray, "cells"]) -> float:
    """Return the square root of the Jensen-Shannon divergence in nats of two histograms."""
    return math.sqrt(max(float(divergence(first, second)), 0.0) * math.log(2))
