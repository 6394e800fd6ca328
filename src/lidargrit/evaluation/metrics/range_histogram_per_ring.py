"""Distribution of range, row by row: two sets → Jensen-Shannon distance, the root of the mean over rows."""

import numpy as np
from jaxtyping import Float64, Int64

from lidargrit.evaluation.metrics import ImageKind
from lidargrit.evaluation.metrics.shared.curves import CurveMetric, histogram, middles, range_edges
from lidargrit.scans.types import RangeImage

_BINS = 32  # of 120 m / 0.9 m: each reaches a sixth farther than the one before


class RangeHistogramPerRing(CurveMetric):
    """Compare the histograms of range of every row, in bins of equal width on a logarithmic axis.

    A row without any return in one set only counts as 1, in both sets as 0.
    """

    title = "Distribution of range in every row"
    axis_label = "range [m]"
    curve_label = "share of the row's returns"

    def count(self, images: RangeImage) -> Int64[np.ndarray, "H bins"]:
        """Count the returns of every row in bins of range."""
        edges = range_edges(ImageKind.of(images.sensor), _BINS)
        rows = zip(images.range_m.transpose(0, 1), images.return_mask.transpose(0, 1), strict=True)
        return np.stack([histogram(range_m[returned], edges) for range_m, returned in rows])

    def axis(self, kind: ImageKind) -> Float64[np.ndarray, " bins"]:
        """Return ranges."""
        return middles(range_edges(kind, _BINS))
