"""Rounded parameters of a mixture of logistics → its distribution function at the borders of steps, bit for bit."""

import numpy as np
from jaxtyping import Float64, Int64

from lidargrit.generation.pixel_decoder.range_mixture import RangeMixture
from lidargrit.generation.range_steps import RangeSteps
from lidargrit.inference.compress.arithmetic import exp, ln, sigmoid
from lidargrit.inference.compress.rounding import CENTRES, LOG_SCALES, WEIGHT_LOGITS, Rounding

_LEAST_LOGIT = -12.0  # of a component that counts, beside the heaviest; lighter ones are left out
_LEAST_MASS = 1e-6


class StepMixture:
    """The distribution of the step that each of n ranges is rounded to.

    Args:
        mixture: mixtures of n ranges in 64 bits, as a network gives them.
        rounding: rounding of their numbers.
    """

    def __init__(self, mixture: RangeMixture, rounding: Rounding, steps: RangeSteps) -> None:
        logits, centres, log_scales = (
            part.T.contiguous().cpu().numpy() for part in (mixture.logits, mixture.centres, mixture.log_scales)
        )
        logits = rounding.indices(logits - logits.max(0), WEIGHT_LOGITS) * WEIGHT_LOGITS.step
        counts = logits > _LEAST_LOGIT
        self.count = logits.shape[1]
        self._steps = steps
        self._weights = np.where(counts, exp(np.maximum(logits, _LEAST_LOGIT)), 0.0)
        self._centres = rounding.indices(centres, CENTRES, counts) * CENTRES.step
        self._inverse = exp(-(rounding.indices(log_scales, LOG_SCALES, counts) * LOG_SCALES.step))
        low_m, high_m = mixture.limits_m
        low, high = (self._component(ln(np.full(self.count, 1 + limit))) for limit in (low_m, high_m))
        self._low, self._high, self._share = low, high, self._weights / np.maximum(high - low, _LEAST_MASS)

    def below(self, index: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """Return each distribution function, times a constant, at the lower border of the step ``index``."""
        edge_m = (index - 0.5) * self._steps.step_mm / 1000
        return self._sum(self._component(ln(1 + edge_m)))

    def ends(self) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """Return the same at the sensor's limits."""
        return np.zeros(self.count), self._sum(self._high)

    def _component(self, v: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "K n"]:
        return sigmoid((v - self._centres) * self._inverse)

    def _sum(self, component: Float64[np.ndarray, "K n"]) -> Float64[np.ndarray, " n"]:
        terms = (component - self._low) * self._share
        total = np.zeros(self.count)
        for term in terms:  # one after the other: sums over an axis are ordered as a machine likes
            total = total + term
        return total
