"""Two sets of features → squared maximum mean discrepancy under a cubic kernel, which small sets do not bias."""

import math
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from lidargrit.evaluation.metrics.shared.accumulators import RowAccumulator
from lidargrit.evaluation.metrics.shared.networks.features import FeatureMetric

_SUBSETS, _SUBSET_SIZE = 100, 1000  # of R2DM, after Bińkowski et al. 2018
_ROWS = 1024  # of a kernel matrix held at once: 40 MB against 5000 scans


class KernelMetric(FeatureMetric[np.ndarray]):
    """Squared kernel distance between the features of two sets.

    It is unbiased, so it may fall a little below 0 for sets of one kind, and sets of any size can be compared.
    ``r2dm`` is the mean over 100 pairs of random subsets of at most 1000 scans each; ``exact`` is the value of all
    pairs of scans at once, without random numbers. Features of all scans are kept: 7 or 16 kB for each.
    """

    bounds = (-math.inf, math.inf)
    accumulator = RowAccumulator

    def compare(
        self, generated: Float32[np.ndarray, "n d"], real: Float32[np.ndarray, "m d"]
    ) -> tuple[float, dict[str, Any]]:
        """Return the distance; the details name the weights."""
        ordered = _in_order(generated), _in_order(real)
        exact = self.variant == "exact"
        value = kernel_distance(*ordered) if exact else subset_kernel_distance(*ordered, self.seed)
        return value, self.weights_details()


def kernel_distance(first: Float[np.ndarray, "n d"], second: Float[np.ndarray, "m d"]) -> float:
    """Return the unbiased squared maximum mean discrepancy under the kernel (x . y / d + 1)^3.

    Source:
        Bińkowski et al., Demystifying MMD GANs, ICLR 2018, eq. 4 and section 3; Gretton et al., A kernel two-sample
        test, JMLR 2012, eq. 3.
    """
    first, second = first.astype(np.float64), second.astype(np.float64)
    between = _kernel_sum(first, second) / (len(first) * len(second))
    within = (
        (_kernel_sum(features, features) - float(_cubic(np.square(features).sum(axis=1), features).sum()))
        / (len(features) * (len(features) - 1))
        for features in (first, second)
    )
    return sum(within) - 2 * between


def subset_kernel_distance(
    first: Float[np.ndarray, "n d"],
    second: Float[np.ndarray, "m d"],
    seed: int,
    at_most: int = _SUBSET_SIZE,
) -> float:
    """Return the mean kernel distance over pairs of equally large random subsets.

    Source:
        kazuto1011/r2dm@ad66e71, with another random source.
    """
    size = min(len(first), len(second), at_most)
    if size == len(first) == len(second):
        return kernel_distance(first, second)  # every subset is the whole set
    rng = np.random.default_rng(seed)
    distances = (
        kernel_distance(*(features[rng.choice(len(features), size, replace=False)] for features in (first, second)))
        for _ in range(_SUBSETS)
    )
    return sum(distances) / _SUBSETS


def _kernel_sum(first: np.ndarray, second: np.ndarray) -> float:
    return sum(
        float(_cubic(first[start : start + _ROWS] @ second.T, second).sum()) for start in range(0, len(first), _ROWS)
    )


def _cubic(products: np.ndarray, features: np.ndarray) -> np.ndarray:
    return (products / features.shape[1] + 1) ** 3


def _in_order(features: Float32[np.ndarray, "n d"]) -> Float32[np.ndarray, "n d"]:
    """Sort scans by their features, so that random subsets do not depend on their order."""
    return features[np.lexsort(features[:, ::-1].T)]
