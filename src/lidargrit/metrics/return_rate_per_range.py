"""Share of rays that return against the range of what they should meet: two sets → Jensen-Shannon distance."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int64

from lidargrit.metrics import ImageKind
from lidargrit.metrics._curves import (
    CurveMetric,
    Curves,
    LocalSurface,
    compare_shares,
    count_shares,
    middles,
    range_edges,
)
from lidargrit.structures import RangeImage


class ReturnRatePerRange(CurveMetric):
    """Compare the share of returns in bins of range, by the divergence in each bin, and the mean over bins.

    A drop has no range of its own. Every pixel, returned or not, gets the range of its neighbours along the row, if
    there is one within 11 degrees on either side and the two agree within a tenth. All others, in the sky, in wide
    holes and at edges, are left out: two thirds of KITTI's drops are, so the curve tells of single drops and small
    holes in surfaces that are seen, not of surfaces that are lost as a whole.
    """

    title = "Share of returns against range"
    measures_raydrop = True
    axis_label = "range [m]"
    curve_label = "share of returns"

    def count(self, images: RangeImage) -> Int64[np.ndarray, "2 bins"]:
        """Count the pixels whose range is known and, among them, the returns."""
        return count_shares(
            LocalSurface.of(images).range_m, images.return_mask, range_edges(ImageKind.of(images.sensor))
        )

    def curves(
        self, generated: Int64[np.ndarray, "2 bins"], real: Int64[np.ndarray, "2 bins"], kind: ImageKind
    ) -> Curves:
        """Return the share of returns over the range."""
        return compare_shares(generated, real, middles(range_edges(kind)))
