"""Points → the range limits of a sensor, and the step in which it counts."""

import math

import numpy as np
from jaxtyping import Float64

_STEPS_M = (0.02, 0.012, 0.01, 0.008, 0.005, 0.004, 0.003, 0.002, 0.001)  # in which sensors and files count
_NEAR_A_STEP = 0.1  # of a step to either side; numbers that know no step are there at every fifth
_SHARE_AT_LEAST = 0.8


def farthest_m(range_m: Float64[np.ndarray, "n"]) -> float:
    """Return a limit that holds all points but one in ten thousand, rounded up to whole metres.

    Scans tell no near limit: other scans of the same sensor may have returns nearer than the nearest of these.
    """
    return float(math.ceil(float(np.quantile(range_m, 0.9999))))


def quantum_m(values_m: Float64[np.ndarray, "n"]) -> float | None:
    """Return the largest step, in metres, of which nearly all values are whole multiples; None if there is none."""
    for step_m in _STEPS_M:
        off = np.abs(values_m / step_m - np.round(values_m / step_m))
        if float((off < _NEAR_A_STEP).mean()) > _SHARE_AT_LEAST:
            return step_m
    return None
