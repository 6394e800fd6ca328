"""Share of rays that return against the angle at which they should strike: two sets → Jensen-Shannon distance."""

import numpy as np
from jaxtyping import Float64, Int64

from lidargrit.evaluation.metrics import ImageKind
from lidargrit.evaluation.metrics.shared.curves import LocalSurface, ShareMetric, count_shares
from lidargrit.scans.types import RangeImage

_EDGES_DEG = np.linspace(0, 90, 19)  # 5 degrees each: what noise of 2 cm does to a plane through points 25 cm apart


class ReturnRateByIncidence(ShareMetric):
    """Compare the share of returns in bins of incidence, by the divergence in each bin, and the mean over bins.

    Every pixel, returned or not, gets the plane of its neighbours: the nearest return on either side along the row and
    along the column. 0 degrees strikes the plane squarely. Pixels with too few neighbours, or whose neighbours lie on
    no common plane, are left out, and with them surfaces that are lost as a whole.
    """

    title = "Share of returns against incidence"
    measures_raydrop = True
    axis_label = "incidence [degrees]"
    curve_label = "share of returns"

    def count(self, images: RangeImage) -> Int64[np.ndarray, "2 bins"]:
        """Count the pixels whose plane is known and, among them, the returns."""
        return count_shares(LocalSurface.of(images).incidence_rad.rad2deg(), images.return_mask, _EDGES_DEG)

    def axis(self, kind: ImageKind) -> Float64[np.ndarray, " bins"]:
        """Return the middle of each bin of incidence."""
        return (_EDGES_DEG[1:] + _EDGES_DEG[:-1]) / 2
