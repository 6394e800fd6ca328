"""Two sets of features → Fréchet distance of the normal distributions with their means and covariances."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Float64

from lidargrit.evaluation.metrics.shared.accumulators import Accumulator
from lidargrit.evaluation.metrics.shared.networks.features import FeatureMetric


class Moments(Accumulator["Moments"]):
    """Mean and covariance of vectors seen in any number of batches, in memory that does not grow with their number.

    Kept are the number n, the mean, and a matrix R with R^T R = sum of (x - mean)(x - mean)^T, with at most 2 d rows
    for d values in a vector. R is a square root of the second moments: it needs no subtraction of large numbers, and
    stays exact where there are fewer vectors than values.

    Source:
        Chan, Golub and LeVeque, Updating formulae and a pairwise algorithm for computing sample variances, 1979, eq.
        2.1b, written for R.
    """

    def __init__(self) -> None:
        self.num = 0
        self.mean: Float64[np.ndarray, " d"] = np.zeros(0)
        self._rows: list[Float64[np.ndarray, "_ d"]] = []

    def add(self, summary: Float[np.ndarray, "n d"]) -> None:
        """Take in a batch of at least one vector."""
        vectors = summary.astype(np.float64)
        mean = vectors.mean(axis=0)
        self._join(len(vectors), mean, [vectors - mean] if len(vectors) > 1 else [])

    def merge(self, other: "Accumulator[Moments]") -> None:
        """Take in the vectors that another has seen."""
        moments = other.value()
        if moments.num:
            self._join(moments.num, moments.mean, moments._rows)

    def value(self) -> "Moments":
        """Return the moments themselves."""
        return self

    def arrays(self) -> dict[str, np.ndarray]:
        """Return number, mean and R."""
        return {"num": np.array(self.num), "mean": self.mean, "rows": self._all_rows()}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take number, mean and R."""
        self.num, self.mean, self._rows = int(arrays["num"]), arrays["mean"], [arrays["rows"]]

    def root(self) -> Float64[np.ndarray, "r d"]:
        """Return a matrix whose product with itself, transposed first, is the unbiased covariance; at most d rows."""
        rows = self._all_rows()
        return (rows if len(rows) <= rows.shape[1] else _shortened(rows)) / math.sqrt(self.num - 1)

    def _all_rows(self) -> Float64[np.ndarray, "r d"]:
        return np.concatenate([np.zeros((0, len(self.mean))), *self._rows])

    def _join(self, num: int, mean: Float64[np.ndarray, " d"], rows: list[Float64[np.ndarray, "_ d"]]) -> None:
        if self.num == 0:
            self.num, self.mean, self._rows = num, mean, list(rows)
            return
        total = self.num + num
        apart = mean - self.mean
        self._rows += [*rows, math.sqrt(self.num * num / total) * apart[None]]
        self.mean, self.num = self.mean + apart * (num / total), total
        if sum(map(len, self._rows)) > 2 * len(mean):
            self._rows = [_shortened(np.concatenate(self._rows))]


def _shortened(rows: Float64[np.ndarray, "r d"]) -> Float64[np.ndarray, "d d"]:
    """Return d rows with the same R^T R."""
    return np.asarray(np.linalg.qr(rows, mode="r"))


def frechet_distance(first: Moments, second: Moments) -> float:
    """Return |m1 - m2|^2 + tr(S1 + S2 - 2 (S1 S2)^(1/2)), the squared Wasserstein-2 distance of two normal laws.

    With S = R^T R the trace of (S1 S2)^(1/2) is the sum of the singular values of R1 R2^T: all real and not negative,
    also where a covariance is singular and the square root of S1 S2, which other programs take, is not reliable.

    Source:
        Dowson and Landau, The Fréchet distance between multivariate normal distributions, 1982.
    """
    roots = [statistics.root() for statistics in (first, second)]
    apart = float(np.square(first.mean - second.mean).sum())
    spread = sum(float(np.square(root).sum()) for root in roots)
    common = float(np.linalg.svd(roots[0] @ roots[1].T, compute_uv=False).sum()) if all(map(len, roots)) else 0.0
    return max(apart + spread - 2 * common, 0.0)  # rounding alone takes it below


class FrechetMetric(FeatureMetric[Moments]):
    """Fréchet distance between the features of two sets.

    It is biased upwards for small sets, and says little where there are fewer scans than features: the details have a
    line about it in ``warnings``. Only values of equally large sets can be compared.
    """

    accumulator = Moments

    def compare(self, generated: Moments, real: Moments) -> tuple[float, dict[str, Any]]:
        """Return the distance; the details name the weights, and warn of small sets."""
        values = len(real.mean)
        warnings = [
            f"{generated.num} generated and {real.num} real scans for {values} features: "
            + "too few for a covariance, so the distance is far too large; "
            + f"use more than {values} of each, or the kernel distance on the same features"
        ]
        too_few = min(generated.num, real.num) < values
        details = {"warnings": warnings if too_few else [], **self.weights_details()}
        return frechet_distance(generated, real), details
