"""Share of neighbours in a row that lie on two surfaces, by range: two sets → Jensen-Shannon distance."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidargrit.evaluation.metrics.shared.curves import ONE_SURFACE, SharePerRangeMetric
from lidargrit.scans.types import RangeImage


class EdgeRatePerRange(SharePerRangeMetric):
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
    by_trials = True

    def ask(self, images: RangeImage) -> tuple[Float[Tensor, "B H W"], Bool[Tensor, "B H W"]]:
        """Return the nearer range of each pair of returns side by side, and which lie on two surfaces."""
        right_m, right_returned = images.range_m.roll(-1, -1), images.return_mask.roll(-1, -1)
        near_m, far_m = torch.minimum(images.range_m, right_m), torch.maximum(images.range_m, right_m)
        near_m = torch.where(images.return_mask & right_returned, near_m, torch.nan)
        return near_m, far_m - near_m > ONE_SURFACE * far_m
