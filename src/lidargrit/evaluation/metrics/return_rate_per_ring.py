"""Share of rays that return, row by row: two sets → Jensen-Shannon distance, the root of the mean over rows."""

import numpy as np
from jaxtyping import Float64, Int64

from lidargrit.evaluation.metrics import ImageKind
from lidargrit.evaluation.metrics.shared.curves import ShareMetric
from lidargrit.scans.types import RangeImage


class ReturnRatePerRing(ShareMetric):
    """Compare the share of pixels that return in every row, by the divergence in each row."""

    title = "Share of returns in every row"
    measures_raydrop = True
    axis_label = "row, from the top"
    curve_label = "share of returns"

    def count(self, images: RangeImage) -> Int64[np.ndarray, "2 H"]:
        """Count the pixels and the returns of every row."""
        returned = images.return_mask.sum(dim=(0, 2)).numpy()
        return np.stack((np.full_like(returned, len(images) * images.sensor.width), returned))

    def axis(self, kind: ImageKind) -> Float64[np.ndarray, " H"]:
        """Return the number of each row."""
        return np.arange(kind.height, dtype=float)
