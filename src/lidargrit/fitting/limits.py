"""Points → the range limits of a sensor, and the step in which it counts."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64

_STEPS_M = (0.02, 0.012, 0.01, 0.008, 0.005, 0.004, 0.003, 0.002, 0.001)  # in which sensors and files count
_NEAR_A_STEP = 0.1  # of a step to either side; numbers that know no step are there at every fifth
_SHARE_AT_LEAST = 0.8


def range_limits_m(range_m: Float64[np.ndarray, "n"]) -> tuple[float, float]:
    """Return limits that hold all points but a few in ten thousand, rounded outwards to 0.1 m and 1 m."""
    low, high = np.quantile(range_m, (0.0005, 0.9999))
    return max(0.1, math.floor(float(low) * 10) / 10), float(math.ceil(float(high)))


def quantum_m(values_m: Float64[np.ndarray, "n"]) -> float | None:
    """Return the largest step, in metres, of which nearly all values are whole multiples; None if there is none."""
    for step_m in _STEPS_M:
        off = np.abs(values_m / step_m - np.round(values_m / step_m))
        if float((off < _NEAR_A_STEP).mean()) > _SHARE_AT_LEAST:
            return step_m
    return None
