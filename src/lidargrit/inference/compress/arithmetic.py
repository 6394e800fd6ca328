"""Functions of which every machine gets the same bits: sums, products and quotients in 64 bits → exp, ln, sigmoid.

The exponential functions of numpy and torch differ in their last bits from machine to machine. IEEE 754 fixes the
results of single additions, multiplications and divisions, and of scaling by powers of 2; every line below is one such
operation on an array, so that no compiler can join two of them.
"""

import math

import numpy as np
from jaxtyping import Float64

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
