"""How far neighbouring returns on walls lie off a straight line: two sets → Jensen-Shannon distance of histograms."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from lidargrit.core.errors import ConfigError
from lidargrit.evaluation.metrics import ImageKind
from lidargrit.evaluation.metrics.shared.curves import ONE_SURFACE, CurveMetric, log_edges, middles
from lidargrit.scans.projection import points_of_pixels
from lidargrit.scans.types import RangeImage

_RUN = 8  # pixels: 0.5 m at 10 m in an image of 1,024 columns, 2 m in one of 256
_ROWS = 32  # the rows that tell whether a surface is upright are those next to a pixel in an image of so many rows
_EDGES_M = log_edges(1e-3, 1.0, 24)  # a twentieth of the range noise of an HDL-64E, to what is no wall


class WallStraightness(CurveMetric):
    """Compare how far 8 neighbouring returns of a row lie off a straight line, seen from above, on upright surfaces.

    A run is 8 neighbouring pixels that all return, where no two neighbours differ by more than a tenth in range: no
    edge lies in it. It is on an upright surface if the mean of its points and the mean of the returns in the same
    columns, one row of 32 above and one below (two rows of 64), differ more in height than in horizontal distance; at
    least half of the pixels must return there. Through the run, seen from above, goes the line with the least squared
    distances; the root of their mean is counted in bins of equal width on a logarithmic axis, less than 1 mm in the
    first and more than 1 m in the last. Runs begin at every pixel, and rows are circular. House walls are straight up
    to the noise of the range; bushes, trees and round corners are not, in real scans neither. Only values of images
    with equally many columns can be compared.

    Source:
        total least squares: Pearson, On lines and planes of closest fit to systems of points in space, 1901; the
        choice of runs is this project's.
    """

    title = "Straightness of walls"
    axis_label = "distance from a straight line [m]"
    curve_label = "share of runs"

    def count(self, images: RangeImage) -> Int64[np.ndarray, " bins"]:
        """Count the runs on upright surfaces in bins of their distance from a line."""
        if images.sensor.width < _RUN:
            got = f"range images of {images.sensor.width} columns for wall_straightness"
            raise ConfigError(got, f"at least {_RUN}, the returns of a run", "choose other metrics")
        points_xyz_m = points_of_pixels(images).double()
        runs = unbroken_runs(images) & upright_runs(points_xyz_m, images.return_mask)
        off_m = distance_from_line(points_xyz_m[..., 0], points_xyz_m[..., 1])[runs]
        return np.histogram(off_m.clamp(*_EDGES_M[[0, -1]].tolist()).numpy(), _EDGES_M)[0]

    def axis(self, kind: ImageKind) -> Float64[np.ndarray, " bins"]:
        """Return distances from a line."""
        return middles(_EDGES_M)


def unbroken_runs(images: RangeImage) -> Bool[Tensor, "B H W"]:
    """Return at which pixels a run of 8 returns without an edge begins."""
    return unbroken(torch.where(images.return_mask, images.range_m, torch.nan), _RUN)


def unbroken(range_m: Float[Tensor, "B H W"], length: int) -> Bool[Tensor, "B H W"]:
    """Return where a run without an edge begins in circular rows; ranges are in metres, NaN for no return."""
    next_m = range_m.roll(-1, dims=-1)
    # Ranges agree within a tenth if their inverses do, and no comparison with NaN holds.
    connected = (range_m - next_m).abs() <= ONE_SURFACE * torch.maximum(range_m, next_m)
    return run_sums(connected.double(), length - 1) == length - 1


def upright_runs(points_xyz_m: Float[Tensor, "B H W 3"], return_mask: Bool[Tensor, "B H W"]) -> Bool[Tensor, "B H W"]:
    """Return at which pixels a run begins whose surface is steeper than 45 degrees, up to the row above or below."""
    step = row_step(points_xyz_m.shape[1])
    means_m = run_means(points_xyz_m, return_mask)
    across_m, up_m = ((each[:, :-step] - each[:, step:]).abs() for each in means_m)
    steep = up_m > across_m
    upright = torch.zeros_like(return_mask)
    upright[:, :-step] |= steep
    upright[:, step:] |= steep
    return upright


def row_step(height: int) -> int:
    """Return how many rows apart the rows are that tell how steep a surface is: one of 32, two of 64."""
    return max(1, height // _ROWS)


def run_means(
    points_xyz_m: Float[Tensor, "B H W 3"], return_mask: Bool[Tensor, "B H W"]
) -> tuple[Float[Tensor, "B H W"], Float[Tensor, "B H W"]]:
    """Return mean horizontal distance and mean height of the run from each pixel; NaN where less than half returns."""
    returns = run_sums(return_mask.double(), _RUN)
    returns = torch.where(returns >= _RUN / 2, returns, torch.nan)
    distance_m, height_m = (
        run_sums(each * return_mask, _RUN) / returns
        for each in (points_xyz_m[..., :2].norm(dim=-1), points_xyz_m[..., 2])
    )
    return distance_m, height_m


def distance_from_line(
    x_m: Float[Tensor, "B H W"], y_m: Float[Tensor, "B H W"], length: int = _RUN
) -> Float[Tensor, "B H W"]:
    """Return the root mean square distance of the run that begins at each pixel from the line that fits it best.

    It is the root of the smaller eigenvalue of the covariance of its points.
    """
    runs = [torch.cat((each, each[..., : length - 1]), dim=-1).unfold(-1, length, 1) for each in (x_m, y_m)]
    x, y = (run - run.mean(dim=-1, keepdim=True) for run in runs)
    xx, yy, xy = (x * x).mean(dim=-1), (y * y).mean(dim=-1), (x * y).mean(dim=-1)
    smaller = (xx + yy) / 2 - torch.hypot((xx - yy) / 2, xy)
    return smaller.clamp(min=0).sqrt()


def run_sums(values: Float[Tensor, "B H W"], length: int) -> Float[Tensor, "B H W"]:
    """Return the sum over the run that begins at each pixel of a circular row."""
    return torch.cat((values, values[..., : length - 1]), dim=-1).unfold(-1, length, 1).sum(dim=-1)
