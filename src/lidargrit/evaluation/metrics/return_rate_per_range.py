"""Share of rays that return against the range of what they should meet: two sets → Jensen-Shannon distance."""

from jaxtyping import Bool, Float
from torch import Tensor

from lidargrit.evaluation.metrics.shared.curves import LocalSurface, SharePerRangeMetric
from lidargrit.scans.types import RangeImage


class ReturnRatePerRange(SharePerRangeMetric):
    """Compare the share of returns in bins of range, by the divergence in each bin, and the mean over bins.

    A drop has no range of its own. Every pixel, returned or not, gets the range of its neighbours along the row, if
    there is one within 11 degrees on either side and the two agree within a tenth. All others, in the sky, in wide
    holes and at edges, are left out: two thirds of KITTI's drops are, so the curve tells of single drops and small
    holes in surfaces that are seen, not of surfaces that are lost as a whole.
    """

    title = "Share of returns against range"
    measures_raydrop = True
    curve_label = "share of returns"

    def ask(self, images: RangeImage) -> tuple[Float[Tensor, "B H W"], Bool[Tensor, "B H W"]]:
        """Return the range that each pixel should meet, and which return."""
        return LocalSurface.of(images).range_m, images.return_mask
