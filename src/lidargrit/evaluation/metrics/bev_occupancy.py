"""How often each square metre seen from above holds a return: two sets → Jensen-Shannon distance, mean over cells."""

import numpy as np
import torch
from jaxtyping import Float64, Int64

from lidargrit.evaluation.metrics import ImageKind
from lidargrit.evaluation.metrics.shared.curves import CurveMetric, Curves, divergence
from lidargrit.scans.projection import points_of_pixels
from lidargrit.scans.types import RangeImage

_HALF_M = 50  # of the grid; its cells are 1 m wide
_CELLS = 2 * _HALF_M


class BevOccupancy(CurveMetric):
    """Compare the share of scans in which a cell of a bird's-eye grid of 100 m holds a return, cell by cell.

    Each cell gives the divergence of two Bernoulli distributions; the mean is over the cells that are occupied in any
    scan of either set. The curves are images: row 0 is behind the sensor (x = -50 m), column 0 to its right
    (y = -50 m). Small sets are always far apart, so only values of equally large sets can be compared.
    """

    title = "Occupancy of square metres seen from above"
    axis_label = "forward, left [m]"
    curve_label = "share of scans"

    def count(self, images: RangeImage) -> Int64[np.ndarray, "2 x y"]:
        """Count, for every cell, the scans and those that occupy it."""
        cell = (points_of_pixels(images)[..., :2] + _HALF_M).floor().long()
        inside = images.return_mask & ((cell >= 0) & (cell < _CELLS)).all(dim=-1)
        occupied = torch.zeros(len(images), _CELLS, _CELLS, dtype=torch.bool)
        scan = torch.arange(len(images))[:, None, None].expand_as(inside)
        occupied[scan[inside], cell[..., 0][inside], cell[..., 1][inside]] = True
        times = occupied.sum(dim=0).numpy()
        return np.stack((np.full_like(times, len(images)), times))

    def axis(self, kind: ImageKind) -> Float64[np.ndarray, " x"]:
        """Return the middles of cells."""
        return np.arange(_CELLS) - _HALF_M + 0.5

    def curves(
        self, generated: Int64[np.ndarray, "2 x y"], real: Int64[np.ndarray, "2 x y"], kind: ImageKind
    ) -> Curves:
        """Return the occupancy of every cell."""
        shares = [counts[1] / counts[0] for counts in (generated, real)]
        ever = (shares[0] > 0) | (shares[1] > 0)
        yes_and_no = [np.stack((share[ever], 1 - share[ever]), axis=-1) for share in shares]
        mean = float(divergence(*yes_and_no).mean()) if ever.any() else 0.0
        return Curves(mean, self.axis(kind), *shares)
