"""Values of single scans → their mean, or the ratio of two means, with a 95 % interval."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.special import stdtrit

from lidargrit.evaluation.intervals import blocks

_GROUPS = 16


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
