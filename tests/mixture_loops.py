"""The mixture of a range in plain numbers: slow loops that tests compare with."""

import math
from collections.abc import Sequence


def density_of_v(components: Sequence[tuple[float, float, float]], limits_m: tuple[float, float], v: float) -> float:
    """Density of v = ln(1 + range) of components, each a weight, a centre and a scale, cut off at the limits."""
    low, high = (math.log1p(limit) for limit in limits_m)
    return sum(
        weight * logistic((v - c) / scale) * logistic((c - v) / scale) / scale / mass_between(low, high, c, scale)
        for weight, c, scale in components
    )


def mass_between(low: float, high: float, centre: float, scale: float) -> float:
    """Probability of a logistic distribution between two numbers, exact in both tails."""
    first, last = (low - centre) / scale, (high - centre) / scale
    if first > 0:
        first, last = -last, -first
    return logistic(last) - logistic(first)


def logistic(z: float) -> float:
    return 1 / (1 + math.exp(-z)) if z > -700 else 0.0
