"""64-bit outputs of networks → integers that are the same on every machine, although the last bits differ."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

Numbers = Float64[np.ndarray, "..."]

_LN2_HIGH = 6.93147180369123816490e-01  # its last 32 bits are 0: products with small integers are exact
_LN2_LOW = 1.90821492927058770002e-10
_EXP_TERMS = [1 / math.factorial(power) for power in range(13, -1, -1)]  # to 1e-17 for |x| <= ln(2) / 2
_LN_TERMS = [1 / power for power in range(23, 0, -2)]  # of the inverse hyperbolic tangent, to 1e-17 below 0.172
_LARGEST = 60.0  # of a logit's size: 1 / (1 + exp(-60)) is 1 in 64 bits


def exp(x: Numbers) -> Numbers:
    """Return e to the power of x, for x within ±700, with an error below 1e-15 of it."""
    whole = np.rint(x * math.log2(math.e))
    rest = x - whole * _LN2_HIGH
    rest = rest - whole * _LN2_LOW
    result = np.full_like(rest, _EXP_TERMS[0])
    for term in _EXP_TERMS[1:]:
        result = result * rest
        result = result + term
    return np.ldexp(result, whole.astype(np.int32))


def ln(x: Numbers) -> Numbers:
    """Return the natural logarithm of positive numbers, with an error below 1e-15."""
    mantissa, exponent = np.frexp(x)
    small = mantissa < math.sqrt(0.5)
    mantissa = np.where(small, mantissa * 2, mantissa)
    exponent = (exponent - small).astype(np.float64)
    ratio = (mantissa - 1) / (mantissa + 1)
    square = ratio * ratio
    result = np.full_like(ratio, _LN_TERMS[0])
    for term in _LN_TERMS[1:]:
        result = result * square
        result = result + term
    result = result * ratio
    result = result * 2 + exponent * _LN2_LOW
    return result + exponent * _LN2_HIGH


def sigmoid(z: Numbers) -> Numbers:
    """Return 1 / (1 + exp(-z)); beyond ±60 it is as at ±60."""
    return 1 / (1 + exp(-np.clip(z, -_LARGEST, _LARGEST)))


ATTEMPTS = 9


@dataclass(frozen=True)
class Grid:
    """Multiples that a kind of number is rounded to.

    Args:
        step: distance between two multiples, a power of 2.
        margin: distance from a rounding border within which another machine might round to the other side. The
            differences seen between machines, numbers of threads and libraries are a tenth of it or less.
    """

    step: float
    margin: float


MASK_LOGITS = Grid(2**-6, 1e-9)
WEIGHT_LOGITS = Grid(2**-5, 2e-10)
LOG_SCALES = Grid(2**-4, 2e-10)
CENTRES = Grid(2**-14, 2e-11)  # of ln(1 + range in metres): 1 mm at 20 m


class TooNearABorderError(Exception):
    """A number lies so near to a border that another machine might round it to the other side."""


@dataclass(frozen=True)
class Rounding:
    """Rounds to grids whose borders are shifted a little from attempt to attempt.

    Args:
        attempt: number from 0 to 8; 0 rounds to the nearest multiple.
        checked: whether numbers near a border are refused, as they are when a scan is compressed.
    """

    attempt: int
    checked: bool

    def indices(
        self, values: Float64[np.ndarray, "..."], grid: Grid, matters: Bool[np.ndarray, "..."] | None = None
    ) -> Int64[np.ndarray, "..."]:
        """Return the multiple that each number is rounded to.

        Args:
            values: numbers of one kind.
            grid: grid of their kind.
            matters: True where the number has an effect; everywhere if not given.
        """
        sign = 1 if self.attempt % 2 else -1
        shift = 0.5 + sign * ((self.attempt + 1) // 2) / 16
        shifted = values * (1 / grid.step) + shift
        whole = np.floor(shifted)
        if self.checked:
            beyond = shifted - whole
            near = np.minimum(beyond, 1 - beyond) * grid.step < grid.margin
            if bool((near if matters is None else near & matters).any()):
                raise TooNearABorderError
        return whole.astype(np.int64)
