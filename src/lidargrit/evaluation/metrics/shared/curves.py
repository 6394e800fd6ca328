"""Counts in the pixels of two sets of range images → curves → the Jensen-Shannon distance between them."""

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, final

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from scipy.special import rel_entr
from torch import Tensor

from lidargrit.evaluation.metrics import ImageKind, ImageMetric, Metric
from lidargrit.evaluation.metrics.shared.accumulators import SumAccumulator
from lidargrit.scans.types import RangeImage

_LEAST = 500  # pixels in a bin: the standard error of a share stays below 0.5 / sqrt(500) = 0.022
_COLUMNS = 256  # neighbours are at least as far away as in an image of so many columns: 25 cm at 10 m,
_ROWS = 32  # and of so many rows: 15 cm at 10 m, against the noise of 2 cm that a range has
_RANGE_BINS = 24  # of 120 m / 0.9 m: each reaches a fifth farther than the one before
_REACH = 8  # times that far they may be: 11 degrees, across the window of a car 5 m away
ONE_SURFACE = 0.1  # two surfaces nearer to one another than that share of their range are taken for one


@dataclass(frozen=True, eq=False)
class Curves:
    """The curves of two sets and how far they are apart.

    Args:
        divergence: Jensen-Shannon divergence, base 2, in [0, 1]; the mean if there are several distributions.
        axis: position of each value along the axis, in the unit of ``axis_label``.
        generated: curve of the generated set; NaN where too little was counted.
        real: curve of the real set; NaN where too little was counted.
    """

    divergence: float
    axis: Float64[np.ndarray, " n"]
    generated: Float64[np.ndarray, "*rows n"]
    real: Float64[np.ndarray, "*rows n"]


class CurveMetric(ImageMetric):
    """Counts a quantity in the pixels of every image, and compares the curves of two sets.

    The value is the Jensen-Shannon distance: the square root of the divergence in base 2, from 0 (alike) to 1 (nothing
    in common). The details hold the curves with their labels: ``axis``, ``generated`` and ``real``, None where too
    little was seen.
    Only counts are kept, so that memory does not grow with the sets and no order of images matters.

    Source:
        Lin, Divergence measures based on the Shannon entropy, IEEE Trans. Information Theory 37(1), 1991, eq. 4.1;
        its square root is a metric: Endres and Schindelin, IEEE Trans. Information Theory 49(7), 2003.
    """

    bounds = (0.0, 1.0)
    fewest_images = 1
    accumulator = SumAccumulator
    axis_label: ClassVar[str]
    """What the axis of the curves is, with its unit."""
    curve_label: ClassVar[str]
    """What the curves are."""

    @abstractmethod
    def count(self, images: RangeImage) -> Int64[np.ndarray, "..."]:
        """Count in a batch; counts of batches add up."""

    @abstractmethod
    def axis(self, kind: ImageKind) -> Float64[np.ndarray, " n"]:
        """Return the position of each value along the axis."""

    def curves(self, generated: Int64[np.ndarray, "..."], real: Int64[np.ndarray, "..."], kind: ImageKind) -> Curves:
        """Compare histograms, one or one a row: the mean divergence of the rows."""
        mean = float(divergence(generated, real).mean())
        return Curves(mean, self.axis(kind), normalised(generated), normalised(real))

    @final
    def summarise(self, features: RangeImage, *, real: bool) -> Int64[np.ndarray, "..."]:
        """Count in a batch of either set."""
        return self.count(features)

    @final
    def compare(
        self, generated: Int64[np.ndarray, "..."], real: Int64[np.ndarray, "..."]
    ) -> tuple[float, dict[str, Any]]:
        """Return the distance, and the curves in the details."""
        assert self.kind is not None
        curves = self.curves(generated, real, self.kind)
        details = {
            "axis_label": self.axis_label,
            "curve_label": self.curve_label,
            "axis": curves.axis.tolist(),
            "generated": _listed(curves.generated),
            "real": _listed(curves.real),
        }
        return math.sqrt(max(curves.divergence, 0.0)), details


def _listed(curve: Float64[np.ndarray, "..."]) -> list[Any]:
    return np.where(np.isnan(curve), None, curve).tolist()  # pyright: ignore[reportArgumentType, reportCallIssue]


def divergence(
    first: Float[np.ndarray, "*rows n"] | Int64[np.ndarray, "*rows n"],
    second: Float[np.ndarray, "*rows n"] | Int64[np.ndarray, "*rows n"],
) -> Float64[np.ndarray, "*rows"]:
    """Return the Jensen-Shannon divergence, base 2, of distributions along the last axis, given as counts or shares.

    Two that are both empty are alike; an empty one and another have nothing in common.
    """
    p, q = (normalised(counts) for counts in (first, second))
    middle = (p + q) / 2
    apart = (rel_entr(p, middle) + rel_entr(q, middle)).sum(axis=-1) / (2 * math.log(2))
    empty = np.isnan(p).any(axis=-1).astype(int) + np.isnan(q).any(axis=-1)
    return np.asarray(np.choose(empty, [apart, 1.0, 0.0]))


def normalised(counts: Float[np.ndarray, "*rows n"] | Int64[np.ndarray, "*rows n"]) -> Float64[np.ndarray, "*rows n"]:
    """Return shares of the last axis, NaN where nothing was counted."""
    total = counts.sum(axis=-1, keepdims=True).astype(float)
    return counts / np.where(total > 0, total, np.nan)


def compare_shares(
    generated: Int64[np.ndarray, "2 n"],
    real: Int64[np.ndarray, "2 n"],
    axis: Float64[np.ndarray, " n"],
    bins: Bool[np.ndarray, " n"] | None = None,
    by_trials: bool = False,
) -> Curves:
    """Compare how often something happens, bin by bin: the mean divergence of the bins' yes and no.

    Every bin has the same weight unless asked otherwise. Bins without a trial in either set are left out. If no bin is
    left, the result is 0 for two sets without any trial, else 1.

    Args:
        generated: numbers of trials and of successes in the generated set.
        real: numbers of trials and of successes in the real set.
        axis: position of each bin along the axis.
        bins: bins that count; those with enough trials (:func:`enough_trials`) if not given.
        by_trials: give each bin the weight of its share of the trials, the mean of both sets.
    """
    kept = (enough_trials(generated, real) if bins is None else bins) & (generated[0] > 0) & (real[0] > 0)
    yes_and_no = [np.stack((counts[1], counts[0] - counts[1]), axis=-1) for counts in (generated, real)]
    each = divergence(*yes_and_no)[kept]
    alike = not (generated[0].any() or real[0].any())
    weights = sum(normalised(counts[0, kept]) for counts in (generated, real)) if by_trials else None
    mean = float(np.average(each, weights=weights)) if len(each) else float(not alike)
    plotted = [np.where(kept, normalised(counts)[:, 0], np.nan) for counts in yes_and_no]
    return Curves(mean, axis, *plotted)


def enough_trials(generated: Int64[np.ndarray, "2 n"], real: Int64[np.ndarray, "2 n"]) -> Bool[np.ndarray, " n"]:
    """Return which bins have at least 500 trials in both sets; if none has, those with any."""
    trials = np.minimum(generated[0], real[0])
    return trials >= _LEAST if (trials >= _LEAST).any() else trials > 0


def log_edges(low: float, high: float, bins: int) -> Float64[np.ndarray, " edges"]:
    """Return the edges of bins that are equally wide on a logarithmic axis."""
    return np.geomspace(low, high, bins + 1)


def range_edges(kind: ImageKind, bins: int = _RANGE_BINS) -> Float64[np.ndarray, " edges"]:
    """Return the edges of bins of range, equally wide on a logarithmic axis, with ranges at the limits inside."""
    edges = log_edges(kind.range_min_m, kind.range_max_m, bins)
    edges[0], edges[-1] = edges[0] * 0.999, edges[-1] * 1.001  # a limit as float32 may lie a little beyond
    return edges


def middles(edges: Float64[np.ndarray, " edges"]) -> Float64[np.ndarray, " n"]:
    """Return the geometric middles of bins."""
    return np.sqrt(edges[1:] * edges[:-1])


def histogram(values: Float[Tensor, " n"], edges: Float64[np.ndarray, " edges"]) -> Int64[np.ndarray, " bins"]:
    """Count values in bins; the last bin holds its upper edge, and what lies outside is in none."""
    return np.histogram(values.double().numpy(), edges)[0]


@dataclass(frozen=True, eq=False)
class LocalSurface:
    """The surface that each ray should meet, estimated from the neighbours of its pixel alone.

    The inverse range of a plane is linear in the direction, so ranges are interpolated as 1 / range. The pixel's own
    return is not used: returns and drops are treated alike, and the share of returns is not biased.

    Args:
        range_m: range interpolated along the row between the nearest return on either side. NaN where one of them is
            missing within 11 degrees, or where the two differ by more than a tenth (the sky, the edge of an object).
        incidence_rad: angle between the ray and the normal of the plane through these two and the nearest returns above
            and below; NaN also where the latter give a range that differs from the first by more than a tenth.
    """

    range_m: Float[Tensor, "B H W"]
    incidence_rad: Float[Tensor, "B H W"]

    @classmethod
    def of(cls, images: RangeImage) -> "LocalSurface":
        """Estimate the surface at every pixel of a batch."""
        sensor = images.sensor
        size = (sensor.height, sensor.width)
        inverse = torch.where(images.return_mask, 1 / images.range_m, torch.nan)  # NaN spreads to whatever uses it
        azimuth, elevation = (angle.expand(size) for angle in (sensor.azimuth_rad, sensor.elevation_rad))
        columns, rows = max(1, sensor.width // _COLUMNS), max(1, sensor.height // _ROWS)
        left, left_at = _nearest(inverse, azimuth, -columns, dim=-1)
        right, right_at = _nearest(inverse, azimuth, columns, dim=-1)
        up, up_at = _nearest(inverse, elevation, -rows, dim=-2)
        down, down_at = _nearest(inverse, elevation, rows, dim=-2)
        to_left, to_right = (left_at - azimuth) % (2 * math.pi), (azimuth - right_at) % (2 * math.pi)
        slope_along_row = (left - right) / (to_left + to_right)
        slope_across = (up - down) / (up_at - down_at)
        by_row = right + slope_along_row * to_right
        by_column = down + slope_across * (elevation - down_at)
        one_surface = (left - right).abs() <= ONE_SURFACE * torch.maximum(left, right)
        by_row = torch.where(one_surface, by_row, torch.nan)
        plane = (by_row - by_column).abs() <= ONE_SURFACE * by_row
        # With m the normal over the plane's distance, 1 / range = m . direction; its slopes are m along the tangents.
        across = torch.hypot(slope_along_row / elevation.cos(), slope_across)
        incidence = torch.where(plane, torch.atan2(across, by_row), torch.nan)
        return cls(1 / by_row, incidence)


def _nearest(
    inverse_per_m: Float[Tensor, "B H W"], angle_rad: Float[Tensor, "H W"], step: int, dim: int
) -> tuple[Float[Tensor, "B H W"], Float[Tensor, "B H W"]]:
    """Return inverse range and angle of the nearest return on one side, from ``step`` to eight steps away, else NaN.

    Rows are circular, columns end at the top and the bottom.
    """
    found = torch.full_like(inverse_per_m, torch.nan)
    at = torch.full_like(inverse_per_m, torch.nan)
    sign = 1 if step > 0 else -1
    outwards = range(step, _REACH * step + sign, sign)
    for shift in reversed(outwards):  # the nearest last: it stays
        moved = inverse_per_m.roll(-shift, dims=dim)
        if dim == -2:  # what came round the edge is no neighbour
            moved[:, slice(-shift, None) if shift > 0 else slice(0, -shift)] = torch.nan
        returned = ~moved.isnan()
        found = torch.where(returned, moved, found)
        at = torch.where(returned, angle_rad.roll(-shift, dims=dim), at)
    return found, at


def count_shares(
    quantity: Float[Tensor, "B H W"], happened: Tensor, edges: Float64[np.ndarray, " edges"]
) -> Int64[np.ndarray, "2 bins"]:
    """Count, in bins of a quantity (NaN where it is unknown), all pixels and those where something happened."""
    finite = ~quantity.isnan()
    return np.stack((histogram(quantity[finite], edges), histogram(quantity[finite & happened], edges)))


class ShareMetric(CurveMetric):
    """Compares how often something happens, bin by bin (:func:`compare_shares`)."""

    by_trials: ClassVar[bool] = False
    """Whether a bin has the weight of its share of the trials."""

    def __init__(self, *, variant: str | None = None, seed: int = 0) -> None:
        super().__init__(variant=variant, seed=seed)
        self._bins: Bool[np.ndarray, " n"] | None = None  # that count; None: those with enough trials in our own sets

    @abstractmethod
    def count(self, images: RangeImage) -> Int64[np.ndarray, "2 n"]:
        """Count the trials of each bin in a batch and, among them, those in which it happened."""

    @final
    def curves(self, generated: Int64[np.ndarray, "2 n"], real: Int64[np.ndarray, "2 n"], kind: ImageKind) -> Curves:
        """Return the shares of both sets, and how far they are apart."""
        return compare_shares(generated, real, self.axis(kind), self._bins, self.by_trials)

    def choose_as(self, whole: Metric[RangeImage, np.ndarray]) -> None:
        """Compare the bins that have enough trials in larger sets."""
        self._bins = enough_trials(*(whole.kept(real=real) for real in (False, True)))


class SharePerRangeMetric(ShareMetric):
    """Compares how often something happens in the pixels of every image, in bins of range."""

    axis_label = "range [m]"

    @abstractmethod
    def ask(self, images: RangeImage) -> tuple[Float[Tensor, "B H W"], Bool[Tensor, "B H W"]]:
        """Return the range of each pixel, NaN where it is not asked, and where it happened."""

    @final
    def count(self, images: RangeImage) -> Int64[np.ndarray, "2 bins"]:
        """Count the pixels asked and, among them, those where it happened."""
        return count_shares(*self.ask(images), range_edges(ImageKind.of(images.sensor)))

    @final
    def axis(self, kind: ImageKind) -> Float64[np.ndarray, " bins"]:
        """Return the middle of each bin of range."""
        return middles(range_edges(kind))
