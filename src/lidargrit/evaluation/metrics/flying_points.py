"""Share of returns in mid-air between two surfaces at an edge: two sets → Jensen-Shannon distance over gap widths."""

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from lidargrit.evaluation.metrics import ImageKind
from lidargrit.evaluation.metrics.shared.curves import ONE_SURFACE, ShareMetric, log_edges, middles
from lidargrit.scans.types import RangeImage

_OFF_M = 0.3  # 15 times the range noise of an HDL-64E, and less than the depth of a person
_EDGES_M = log_edges(1.0, 64.0, 12)  # of the gap: three times the distance above, to the ends of a street


class FlyingPoints(ShareMetric):
    """Compare how often a return at an edge lies in mid-air, by the width of the gap between the two surfaces.

    A pixel is at an edge if the two returns on its left lie on one surface (their ranges agree within a tenth), the two
    on its right lie on one surface, and these surfaces, extended to the ray of the pixel, are at least 1 m apart. Its
    return is a flying point if it is farther than 0.3 m from both surfaces and lies between them. Surfaces are
    extended linearly in inverse range, which is exact for planes up to the curvature of one pixel, so a wall that is
    struck at a grazing angle is no edge. Rows are circular. The value is the mean divergence over bins of gap width.
    Real scans have flying points too: thin objects in a gap, and beams that are split by an edge.

    Source:
        the phenomenon: Tang et al., A comparative analysis of depth-discontinuity and mixed-pixel detection algorithms,
        3DIM 2007; the definition is this project's.
    """

    title = "Share of returns in mid-air at edges"
    axis_label = "gap between the surfaces [m]"
    curve_label = "share of flying points"

    def count(self, images: RangeImage) -> Int64[np.ndarray, "2 bins"]:
        """Count the returns at edges and, among them, the flying points."""
        left_m, right_m = (extended_surface(images, side) for side in (1, -1))
        near_m, far_m = torch.minimum(left_m, right_m), torch.maximum(left_m, right_m)
        gap_m = torch.where(images.return_mask, far_m - near_m, torch.nan)
        flying = (images.range_m > near_m + _OFF_M) & (images.range_m < far_m - _OFF_M)
        bins = np.digitize(gap_m.numpy(), _EDGES_M) - 1  # NaN comes after the last bin
        shown = bins >= 0
        counts = [np.bincount(bins[some], minlength=len(_EDGES_M)) for some in (shown, shown & flying.numpy())]
        return np.stack(counts)[:, : len(_EDGES_M) - 1]

    def axis(self, kind: ImageKind) -> Float64[np.ndarray, " bins"]:
        """Return the middle of each bin of the width of the gap."""
        return middles(_EDGES_M)


def extended_surface(images: RangeImage, side: int) -> Float[Tensor, "B H W"]:
    """Return the range at which the ray of each pixel meets the surface of its two neighbours on one side.

    Args:
        side: 1 for the neighbours on the left, -1 for those on the right.

    Returns:
        metres; NaN where one of the two has no return, where they lie on two surfaces, or where the surface, extended,
        lies behind the sensor.
    """
    inverse_per_m = torch.where(images.return_mask, 1 / images.range_m, torch.nan)
    next_per_m, second_per_m = (inverse_per_m.roll(side * steps, dims=-1) for steps in (1, 2))
    one_surface = (next_per_m - second_per_m).abs() <= ONE_SURFACE * torch.maximum(next_per_m, second_per_m)
    extended_per_m = 2 * next_per_m - second_per_m
    return torch.where(one_surface & (extended_per_m > 0), 1 / extended_per_m, torch.nan)
