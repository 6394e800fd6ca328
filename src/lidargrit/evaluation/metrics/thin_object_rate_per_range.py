"""Share of returns from objects one pixel wide, by the range behind them: two sets → Jensen-Shannon distance."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidargrit.evaluation.metrics.shared.curves import ONE_SURFACE, SharePerRangeMetric
from lidargrit.scans.types import RangeImage


class ThinObjectRatePerRange(SharePerRangeMetric):
    """Compare how often a return stands before the one surface to its left and right, as that of a pole does.

    Asked are returns whose two neighbours in the row return, too, and lie on one surface: their ranges differ by at
    most a tenth of the farther one. A return stands before them if it is nearer than the nearer one by more than a
    tenth of that. Bins are of the range of the nearer neighbour; the value is the mean divergence over bins,
    each with the weight of its share of the returns asked. Rows are circular.

    Source:
        the definition is this project's.
    """

    title = "Share of returns from objects one pixel wide"
    axis_label = "range of the surface behind [m]"
    curve_label = "share of thin objects"
    by_trials = True

    def ask(self, images: RangeImage) -> tuple[Float[Tensor, "B H W"], Bool[Tensor, "B H W"]]:
        """Return the range behind each return between two of one surface, and which stand before it."""
        left_m, right_m = images.range_m.roll(1, -1), images.range_m.roll(-1, -1)
        near_m, far_m = torch.minimum(left_m, right_m), torch.maximum(left_m, right_m)
        all_return = images.return_mask & images.return_mask.roll(1, -1) & images.return_mask.roll(-1, -1)
        behind_m = torch.where(all_return & (far_m - near_m <= ONE_SURFACE * far_m), near_m, torch.nan)
        return behind_m, images.range_m < (1 - ONE_SURFACE) * near_m
