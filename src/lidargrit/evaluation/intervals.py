"""Uncertainty of a score: metrics fed with parts of two sets → 95 % interval, and real against real.

A set is cut into groups of neighbouring scans, and each group is fed to a metric of its own. Random halves of the
groups of both sets, taken without replacement, are merged and computed. The spread of these values about their mean is
the standard error of the value of the whole sets: of n values of variance s², the mean of a half without replacement
has variance (1 - 1/2) s² / (n/2) = s²/n, just that of the mean of all. No scan is taken twice, as a bootstrap would: a
twin is its own nearest neighbour, and every metric that looks for neighbours would see it.

Source:
    McCarthy, Pseudo-replication: half samples, Review of the International Statistical Institute 37(3), 1969; Shao and
    Wu, A general theory for jackknife variance estimation, Annals of Statistics 17(3), 1989 (delete-d jackknife: the
    factor (n - d) / d is 1 for d = n / 2); Politis, Romano and Wolf, Subsampling, 1999, chapter 2.
"""

import math
import pickle
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from scipy.special import stdtrit

from lidargrit.core.errors import ConfigError, DataError
from lidargrit.evaluation.metrics import Metric, MetricResult

_HALVINGS = 5  # of the reference against itself: their mean is reported, not their spread
_AT_LEAST = 4  # groups: fewer have too few halves
_LARGE_BYTES = 8 << 20
_GROUPS = 16


@dataclass(frozen=True)
class Resampling:
    """Number of groups and of half-samples for intervals.

    Args:
        groups: number of groups into which each set is cut, 4 or more; fewer if there are fewer scans.
        halves: number of random halves from which the standard error is taken; 0 for neither interval nor real
            against real.
        seed: seed of the choice of halves, the same for every metric.
    """

    groups: int = 16
    halves: int = 20
    seed: int = 0

    def __post_init__(self) -> None:
        if self.halves and not (self.groups >= _AT_LEAST and self.halves >= 2):
            raise ConfigError(
                f"--intervals {self.halves} with --groups {self.groups}",
                f"at least --intervals 2 with --groups {_AT_LEAST}, or --intervals 0 for none",
                "raise the one that is too small",
            )


@dataclass(frozen=True)
class Interval:
    """A 95 % confidence interval of a score, over the choice of scans in the two sets.

    Args:
        low: value minus t standard errors, clipped to the metric's bounds, and to 0 if no half-sample is below 0. t is
            Student's 97.5 % quantile: 2.13 for 16 groups and 20 halves (1.96 for many), since few halves give only a
            rough standard error.
        high: value plus t standard errors, clipped to the metric's bounds.
        mean_of_halves: mean score of half-samples, which have as many scans as the halves of real against real; None if
            it is not known.
        values: scores of the half-samples; none if they are not known. Systems that were scored alike, against the same
            scans, have the same halves of these.
    """

    low: float
    high: float
    standard_error: float
    halves: int
    mean_of_halves: float | None = None
    values: tuple[float, ...] = ()


@dataclass(frozen=True)
class RealAgainstReal:
    """Score of real scans in place of the samples: between as many scans, no generator can be expected to do better.

    Args:
        value: mean over halvings of the reference, one half against the other.
        num_scans: number of scans in each half, on average. Most metrics fall as sets grow, some by a third where they
            double: so compare it with ``Interval.mean_of_halves``.
        spread: standard deviation of the scores of single halvings; None if it is not known.
    """

    value: float
    num_scans: int
    halvings: int
    spread: float | None = None


@dataclass(frozen=True)
class Score:
    """One score with its interval and its reference rows.

    Args:
        interval: 95 % interval; None if it was not wanted or cannot be computed.
        real_against_real: score of real scans in place of the samples; None if it was not computed.
        seconds: time that the metric, its interval and real against real took.
        pixel_statistics: score of scans in place of the samples, each of whose pixels comes from another scan of one
            half of the reference, against the other half; None if it was not computed.
    """

    result: MetricResult
    interval: Interval | None = None
    real_against_real: RealAgainstReal | None = None
    seconds: float = 0.0
    pixel_statistics: float | None = None


def blocks(count: int, groups: int) -> list[range]:
    """Cut ``count`` scans into groups of neighbours, an even number of them, as alike in size as can be.

    Neighbours in time show the same street: they stay together, so that halves differ as other drives would.
    """
    groups = min(groups, count)
    groups -= groups % 2 if groups > 1 else 0
    edges = [index * count // groups for index in range(groups + 1)] if groups else []
    return [range(first, last) for first, last in pairwise(edges)]


class Part:
    """A metric that was fed one group; where its state is large and mostly zeros, kept compressed.

    Counts in 2000x2000 cells take 32 MB for each of 48 groups, and compressed a hundredth of that.
    """

    def __init__(self, metric: Metric) -> None:
        self._metric: Metric | None = metric
        self._packed = b""
        state = pickle.dumps(metric)
        if len(state) > _LARGE_BYTES:
            packed = zlib.compress(state, 1)
            if len(packed) < len(state) / 4:  # else it is of numbers that do not shrink
                self._metric, self._packed = None, packed

    def metric(self) -> Metric:
        """Return the metric, to be read only."""
        return self._metric or pickle.loads(zlib.decompress(self._packed))

    def copy(self) -> Metric:
        """Return a copy of the metric."""
        return pickle.loads(zlib.decompress(self._packed) if self._metric is None else pickle.dumps(self._metric))


def merged(generated: Sequence[Part], real: Sequence[Part], whole: Metric | None = None) -> Metric:
    """Return a new metric that has seen what the parts of both sets were fed, in their order.

    Args:
        whole: metric of larger sets whose choices are to be made; see :meth:`Metric.choose_as`.
    """
    metric = real[0].copy()
    for part in (*generated, *real[1:]):
        metric.merge(part.metric())
    if whole is not None:
        metric.choose_as(whole)
    return metric


def interval_of(
    value: float, whole: Metric, generated: Sequence[Part], real: Sequence[Part], resampling: Resampling
) -> Interval | None:
    """Return the confidence interval of the score of the whole sets; None if there are too few scans."""
    if min(len(generated), len(real)) < _AT_LEAST:
        return None
    rng = np.random.default_rng((resampling.seed, 1))
    values = []
    for _ in range(resampling.halves):
        halves = [
            [features[index] for index in sorted(rng.permutation(len(features))[: len(features) // 2])]
            for features in (generated, real)
        ]
        try:
            values.append(merged(halves[0], halves[1], whole).compute().value)
        except DataError:  # half of the scans are too few for this metric
            return None
    return around(value, values, min(len(generated), len(real)), whole.bounds)


def around(value: float, half_values: Sequence[float], groups: int, bounds: tuple[float, float]) -> Interval:
    """Return the interval around a score.

    The spread of the half-samples is taken about their own mean: a score of half as many scans is biased against that
    of all.
    """
    error, reach = spread_of(half_values, groups)
    least = max(bounds[0], 0.0) if min(value, *half_values) >= 0 else bounds[0]
    low, high = max(value - reach, least), min(value + reach, bounds[1])
    return Interval(low, high, error, len(half_values), float(np.mean(half_values)), tuple(half_values))


def spread_of(half_values: Sequence[float], groups: int, together: int = 1) -> tuple[float, float]:
    """Return the standard error of a score, and half the width of its 95 % interval.

    Args:
        together: number of scores that the 95 % hold for at once (Bonferroni).
    """
    error = float(np.std(half_values, ddof=1))
    return error, error * float(stdtrit(min(groups, len(half_values)) - 1, 1 - 0.025 / together))


def real_against_real(
    whole: Metric, real: Sequence[Part], real_as_generated: Sequence[Part], sizes: Sequence[int], resampling: Resampling
) -> RealAgainstReal | None:
    """Return the mean score of one half of the reference against the other; None if there are too few scans."""
    if len(real) < _AT_LEAST:
        return None
    rng = np.random.default_rng((resampling.seed, 2))
    values = []
    for _ in range(_HALVINGS):
        order = rng.permutation(len(real))
        half, other = sorted(order[: len(order) // 2]), sorted(order[len(order) // 2 :])
        metric = merged([real_as_generated[index] for index in half], [real[index] for index in other], whole)
        try:
            values.append(metric.compute().value)
        except DataError:
            return None
    return RealAgainstReal(float(np.mean(values)), sum(sizes) // 2, _HALVINGS, float(np.std(values, ddof=1)))


def format_value(value: float) -> str:
    """Return a number with four significant digits."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    return f"{value:.4f}" if 1e-2 <= abs(value) < 1e3 else f"{value:.4g}"


@dataclass(frozen=True)
class Estimate:
    """A mean over scans, or a ratio of two.

    Args:
        value: mean or ratio; NaN where no scan has a value.
        low: lower end of its 95 % interval, from groups of neighbouring scans; NaN with fewer than two groups.
        high: upper end of the interval.
    """

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> "Estimate":
        """Return the mean of one value a scan, without those that are NaN, with Student's interval over groups."""
        every = np.asarray(values, dtype=float)
        present = every[~np.isnan(every)]
        mean = float(present.mean()) if len(present) else math.nan
        return cls._around(mean, every)

    @classmethod
    def of_ratio(cls, values: Sequence[float], counts: Sequence[float]) -> "Estimate":
        """Return the sum of the values by the sum of the counts, such as bits by returns, with the same interval.

        Source:
            Cochran, Sampling Techniques, 1977, section 6.3: the variance of a ratio from residuals.
        """
        value, count = np.asarray(values, dtype=float), np.asarray(counts, dtype=float)
        if not count.sum() > 0:
            return cls(math.nan, math.nan, math.nan)
        ratio = float(value.sum() / count.sum())
        return cls._around(ratio, ratio + (value - ratio * count) / count.mean())

    def as_text(self, form: str) -> str:
        """Return the value and its interval, if there is one, in a format such as ``.3f``."""
        interval = "" if math.isnan(self.low) else f" [{self.low:{form}}, {self.high:{form}}]"
        return f"{self.value:{form}}{interval}"

    @classmethod
    def _around(cls, estimate: float, values: Float64[np.ndarray, " n"]) -> "Estimate":
        groups = [values[group.start : group.stop] for group in blocks(len(values), _GROUPS)]
        means = np.asarray([group[~np.isnan(group)].mean() for group in groups if not np.isnan(group).all()])
        if len(means) < 2:
            return cls(estimate, math.nan, math.nan)
        reach = float(stdtrit(len(means) - 1, 0.975) * means.std(ddof=1) / math.sqrt(len(means)))
        return cls(estimate, estimate - reach, estimate + reach)
