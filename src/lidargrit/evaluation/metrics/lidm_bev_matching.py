"""Which 0.5 m cells, seen from above, hold points: two sets → minimum matching distance, LiDM's "MMD"."""

from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8
from scipy.ndimage import distance_transform_edt

from lidargrit.evaluation.metrics import ImageMetric
from lidargrit.evaluation.metrics.shared.accumulators import RowAccumulator
from lidargrit.evaluation.metrics.shared.birds_eye import LIDM_HALF_M, occupied_cells
from lidargrit.scans.types import RangeImage

_CELLS_PER_M = 2
_SIDE = 2 * LIDM_HALF_M * _CELLS_PER_M  # 200 cells
_BLOCK = 64  # scans: occupancy and distances take 41 MB


class LidmBevMatching(ImageMetric):
    """Find for every real scan the generated one whose occupied cells are nearest; the value is the mean of these.

    LiDM's tables call it "MMD"; it is a minimum matching distance, not a maximum mean discrepancy. A scan is the set
    of its occupied cells of 0.5 m within +-50 m, their positions in [0, 1). Two scans are apart by half the sum of both
    means of the squared distance from a cell of one to the nearest of the other. A generated set that lacks kinds of
    scenes scores badly; one that adds wrong ones does not. A scan without a point in the grid counts as one occupied
    cell at the sensor.

    Distances to the nearest occupied cell are taken once a scan for the whole grid (a distance transform of whole
    numbers of cells), which makes the comparison of all pairs a product of two matrices, and exact.
    A scan takes 5 kB; time grows with the product of the numbers of scans.

    Args:
        variant: ``exact`` only; the toolbox computes the same in single precision.

    Source:
        Ran et al., Towards realistic scene generation with LiDAR diffusion models, CVPR 2024; cells and
        scale of lidm/eval of hancyran/LiDAR-Diffusion@4c94f10, setting for 64 rows.
    """

    title = "Minimum matching distance of occupied 0.5 m cells (LiDM)"
    accumulator = RowAccumulator

    def summarise(self, features: RangeImage, *, real: bool) -> UInt8[np.ndarray, "B bytes"]:
        """Return one bit for every cell of every scan."""
        occupied = np.zeros((len(features), _SIDE, _SIDE), dtype=bool)
        occupied.ravel()[occupied_cells(features, _CELLS_PER_M)] = True
        occupied[~occupied.any(axis=(1, 2)), _SIDE // 2, _SIDE // 2] = True
        return np.packbits(occupied.reshape(len(features), -1), axis=1)

    def compare(
        self, generated: UInt8[np.ndarray, "n bytes"], real: UInt8[np.ndarray, "m bytes"]
    ) -> tuple[float, dict[str, Any]]:
        """Return the mean over real scans of the distance to the nearest generated one."""
        nearest = [
            pair_distances(some, generated).min(axis=1) for some in np.split(real, range(_BLOCK, len(real), _BLOCK))
        ]
        return float(np.concatenate(nearest).mean()), {}


def pair_distances(
    first: UInt8[np.ndarray, "n bytes"], second: UInt8[np.ndarray, "m bytes"]
) -> Float64[np.ndarray, "n m"]:
    """Return how far all pairs of scans are apart, in squares of the width of the grid."""
    shares, squared = occupancy_and_distance(first)
    columns = []
    for start in range(0, len(second), _BLOCK):
        other_shares, other_squared = occupancy_and_distance(second[start : start + _BLOCK])
        columns.append(shares @ other_squared.T + squared @ other_shares.T)
    return np.concatenate(columns, axis=1) / (2 * _SIDE**2)


def occupancy_and_distance(
    bits: UInt8[np.ndarray, "n bytes"],
) -> tuple[Float64[np.ndarray, "n cells"], Float64[np.ndarray, "n cells"]]:
    """Return for all cells of every scan 1 / number of occupied ones, or 0, and the square of the way to the nearest.

    Ways are counted in cells: their squares are whole numbers.
    """
    occupied = np.unpackbits(bits, axis=1).astype(bool)
    squared = np.empty(occupied.shape)
    for scan, row in zip(occupied, squared, strict=True):
        ways = np.asarray(distance_transform_edt(~scan.reshape(_SIDE, _SIDE)))
        row[:] = np.rint(np.square(ways)).ravel()
    return occupied / occupied.sum(axis=1, keepdims=True), squared
