"""How often the neighbour of a drop drops too, at several lags: two sets → Jensen-Shannon distance, mean over lags."""

import numpy as np
from jaxtyping import Float64, Int64

from lidargrit.evaluation.metrics import ImageKind
from lidargrit.evaluation.metrics.shared.curves import ShareMetric
from lidargrit.scans.types import RangeImage

_COLUMN_LAGS = (1, 2, 4, 8, 16)
_ROW_LAGS = (1, 2)


class DropCorrelation(ShareMetric):
    """Compare the probability that the pixel at a lag has no return either, by the divergence at each lag.

    The lags are 1, 2, 4, 8 and 16 columns, rows being circular, and 1 and 2 rows, where there is such a row. Along the
    axis of the curves rows are negative. A drop is a pixel without a return, for whatever cause, the sky included.
    """

    title = "How often neighbours of drops drop too"
    measures_raydrop = True
    axis_label = "lag [pixels; negative: rows]"
    curve_label = "share of drops"

    def count(self, images: RangeImage) -> Int64[np.ndarray, "2 lags"]:
        """Count the drops that have a neighbour at a lag, and those whose neighbour drops."""
        dropped = ~images.return_mask
        pairs = [(dropped[:, :-lag], dropped[:, lag:]) for lag in _ROW_LAGS[::-1]]
        pairs += [(dropped, dropped.roll(-lag, dims=2)) for lag in _COLUMN_LAGS]
        return np.array([[int(one.sum()) for one, _ in pairs], [int((one & other).sum()) for one, other in pairs]])

    def axis(self, kind: ImageKind) -> Float64[np.ndarray, " lags"]:
        """Return the lags: rows, negative, then columns."""
        return np.array([-lag for lag in _ROW_LAGS[::-1]] + list(_COLUMN_LAGS), dtype=float)
