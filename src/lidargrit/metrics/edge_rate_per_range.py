"""Share of neighbours in a row that lie on two surfaces, by range: two sets → Jensen-Shannon distance."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Int64

from lidargrit.metrics import ImageKind
from lidargrit.metrics._curves import (
    ONE_SURFACE,
    CurveMetric,
    Curves,
    compare_shares,
    count_shares,
    middles,
    range_edges,
)
from lidargrit.structures import RangeImage


class EdgeRatePerRange(CurveMetric):
    """Compare how often two neighbours in a row, which both return, lie on two surfaces, in bins of the nearer range.

    They do if their ranges differ by more than a tenth of the farther one. The value is the mean divergence over bins,
    each with the weight of its share of such neighbours.
    Other scores of edges, as ``flying_points``, are shares of the edges that there are: a generator that smooths scenes
    does well in these, and badly here. Rows are circular.

    Source:
        the definition is this project's.
    """

    title = "Share of neighbours on two surfaces"
    axis_label = "range of the nearer [m]"
    curve_label = "share of edges"

    def count(self, images: RangeImage) -> Int64[np.ndarray, "2 bins"]:
        """Count the pairs of returns side by side and, among them, those on two surfaces."""
        right_m, right_returned = images.range_m.roll(-1, -1), images.return_mask.roll(-1, -1)
        near_m, far_m = torch.minimum(images.range_m, right_m), torch.maximum(images.range_m, right_m)
        near_m = torch.where(images.return_mask & right_returned, near_m, torch.nan)
        return count_shares(near_m, far_m - near_m > ONE_SURFACE * far_m, range_edges(ImageKind.of(images.sensor)))

    def curves(
        self, generated: Int64[np.ndarray, "2 bins"], real: Int64[np.ndarray, "2 bins"], kind: ImageKind
    ) -> Curves:
        """Return the share of edges over the range."""
        return compare_shares(generated, real, middles(range_edges(kind)), by_trials=True)
