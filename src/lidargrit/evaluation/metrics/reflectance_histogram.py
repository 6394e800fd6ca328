"""Distribution of reflectance over the returns: two sets that have it → Jensen-Shannon distance."""

import numpy as np
import torch
from jaxtyping import Float64, Int64

from lidargrit.core.errors import DataError
from lidargrit.evaluation.metrics import ImageKind
from lidargrit.evaluation.metrics.shared.curves import CurveMetric
from lidargrit.scans.types import RangeImage

_STEPS = 50  # bins of 0.02, two of the hundredths that KITTI's files hold


class ReflectanceHistogram(CurveMetric):
    """Compare the histograms of reflectance of all returns."""

    title = "Distribution of reflectance"
    axis_label = "reflectance"
    curve_label = "share of returns"

    def count(self, images: RangeImage) -> Int64[np.ndarray, " bins"]:
        """Count the returns in bins of reflectance."""
        if images.reflectance is None:
            raise DataError(
                f"range images without reflectance for {self.name!r}",
                "reflectance in both sets",
                "leave this metric out, or take scans whose files have it",
            )
        values = images.reflectance[images.return_mask]
        index = (values * _STEPS + 0.25).long()  # a quarter: no hundredth falls on the edge of a bin
        return torch.bincount(index, minlength=_STEPS + 1).numpy()

    def axis(self, kind: ImageKind) -> Float64[np.ndarray, " bins"]:
        """Return reflectances."""
        return (np.arange(_STEPS + 1) + 0.25) / _STEPS
