"""Decisions with known probabilities ⇄ 32-bit words: a range coder, and how integers and ranges become decisions."""

import importlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float64, Int64

from lidargrit.core.errors import ConfigError, ScanError
from lidargrit.generation.pixel_decoder.range_mixture import RangeMixture
from lidargrit.generation.range_steps import RangeSteps
from lidargrit.inference.compress.rounding import (
    ATTEMPTS,
    CENTRES,
    LOG_SCALES,
    WEIGHT_LOGITS,
    Rounding,
    TooNearABorderError,
    exp,
    ln,
    sigmoid,
)

_LEAST_LOGIT = -12.0  # of a component that counts, beside the heaviest; lighter ones are left out
_LEAST_MASS = 1e-6


class StepMixture:
    """The distribution of the step that each of n ranges is rounded to.

    Args:
        mixture: mixtures of n ranges in 64 bits, as a network gives them.
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


ONE = 1 << 16  # probabilities are counted in 65,536ths, and are never 0 or 1
_SHIFTED = np.array([ONE // 100])  # probability that borders are shifted, in one phase of a scan
RoundedT = TypeVar("RoundedT")


def range_coding() -> Any:
    """Return constriction's stream coders."""
    try:
        return importlib.import_module("constriction").stream
    except ImportError:
        cure = 'install it: pip install "lidargrit[compression]"'
        raise ConfigError("no package constriction", "the range coder of the extra compression", cure) from None


class Coder(ABC):
    """Base of encoder and decoder, which go through the same decisions; only the encoder knows the outcomes."""

    def __init__(self) -> None:
        stream = range_coding()
        self._queue, self._model = stream.queue, stream.model

    def decisions(
        self, probability: Int64[np.ndarray, " n"], outcome: Bool[np.ndarray, " n"] | None
    ) -> Bool[np.ndarray, " n"]:
        """Code or decode decisions, and return their outcomes.

        Args:
            probability: probability that each is True, in 65,536ths.
            outcome: outcomes, to code them; None to decode.
        """
        share = np.clip(probability, 1, ONE - 1).astype(np.float32) / np.float32(ONE)  # exact in 32 bits
        return self._pass(self._model.Bernoulli(perfect=False), outcome, share) if len(share) else share > 1

    @abstractmethod
    def rounded(self, by: Callable[[Rounding], RoundedT]) -> RoundedT:
        """Return numbers, rounded with borders that are coded or decoded before.

        Args:
            by: function that rounds; it raises :class:`TooNearABorderError` if roundings are checked.
        """

    def uniform(self, count: int, size: int, numbers: Int64[np.ndarray, " n"] | None) -> Int64[np.ndarray, " n"]:
        """Code or decode ``count`` numbers below ``size``, each as likely as another."""
        if size == 1:
            return np.zeros(count, dtype=np.int64)
        return self._pass_equal(self._model.Uniform(size), count, numbers)

    def integers(
        self, mixture: StepMixture, first: int, last: int, values: Int64[np.ndarray, " n"] | None
    ) -> Int64[np.ndarray, " n"]:
        """Code or decode integers from ``first`` to ``last`` by halving the interval again and again.

        Args:
            mixture: distribution of each integer.
            first: least of the integers.
            last: greatest of the integers.
            values: integers, to code them; None to decode.
        """
        low, high = np.full(mixture.count, first), np.full(mixture.count, last + 1)
        below, above = mixture.ends()
        while bool((high - low > 1).any()):
            middle = (low + high) // 2
            at_middle = np.clip(mixture.below(middle), below, above)
            upper = self._halve(high - low > 1, (below, at_middle, above), None if values is None else values >= middle)
            low, below = np.where(upper, middle, low), np.where(upper, at_middle, below)
            high, above = np.where(upper, high, middle), np.where(upper, above, at_middle)
            # What is decided keeps an interval of one integer.
            high = np.where(high == low, low + 1, high)
        return low

    def _halve(
        self,
        undecided: Bool[np.ndarray, " n"],
        at: tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]],
        upper: Bool[np.ndarray, " n"] | None,
    ) -> Bool[np.ndarray, " n"]:
        """Code or decode whether undecided integers lie in the upper half."""
        below, middle, above = (each[undecided] for each in at)
        mass = above - below
        some = mass > 0
        share = np.where(some, (above - middle) / np.where(some, mass, 1.0), 0.5)  # where nothing is left, evenly
        known = None if upper is None else upper[undecided]
        found = np.zeros(len(undecided), dtype=bool)
        found[undecided] = self.decisions(np.rint(share * ONE).astype(np.int64), known)
        return found

    @abstractmethod
    def _pass(self, family: Any, outcome: Bool[np.ndarray, " n"] | None, share: np.ndarray) -> Bool[np.ndarray, " n"]:
        """Code or decode decisions."""

    @abstractmethod
    def _pass_equal(self, model: Any, count: int, numbers: Int64[np.ndarray, " n"] | None) -> Int64[np.ndarray, " n"]:
        """Code or decode numbers of one distribution."""


class Encoder(Coder):
    """Writes the outcomes of decisions."""

    def __init__(self) -> None:
        super().__init__()
        self._encoder = self._queue.RangeEncoder()

    def words(self) -> bytes:
        """Return what was written, in the byte order of little-endian machines."""
        return self._encoder.get_compressed().astype("<u4").tobytes()

    def rounded(self, by: Callable[[Rounding], RoundedT]) -> RoundedT:
        """Code the first attempt in which no number lies near a border."""
        for attempt in range(ATTEMPTS):
            try:
                found = by(Rounding(attempt, checked=True))
            except TooNearABorderError:
                continue
            if self.decisions(_SHIFTED, np.array([attempt > 0]))[0]:
                self.uniform(1, ATTEMPTS, np.array([attempt]))
            return found
        raise ScanError(
            f"a scan whose probabilities cannot be rounded alike on all machines ({ATTEMPTS} ways tried)",
            "one whose can",
            "leave it out, and report it with the file",
        )

    def _pass(self, family: Any, outcome: Bool[np.ndarray, " n"] | None, share: np.ndarray) -> Bool[np.ndarray, " n"]:
        assert outcome is not None
        self._encoder.encode(outcome.astype(np.int32), family, share)
        return outcome

    def _pass_equal(self, model: Any, count: int, numbers: Int64[np.ndarray, " n"] | None) -> Int64[np.ndarray, " n"]:
        assert numbers is not None
        self._encoder.encode(numbers.astype(np.int32), model)
        return numbers


class Decoder(Coder):
    """Reads what an :class:`Encoder` wrote."""

    def __init__(self, words: bytes) -> None:
        super().__init__()
        self._decoder = self._queue.RangeDecoder(np.frombuffer(words, dtype="<u4").astype(np.uint32))

    def rounded(self, by: Callable[[Rounding], RoundedT]) -> RoundedT:
        """Decode the attempt, and round without checks."""
        shifted = bool(self.decisions(_SHIFTED, None)[0])
        return by(Rounding(int(self.uniform(1, ATTEMPTS, None)[0]) if shifted else 0, checked=False))

    def _pass(self, family: Any, outcome: Bool[np.ndarray, " n"] | None, share: np.ndarray) -> Bool[np.ndarray, " n"]:
        return self._read(family, share).astype(bool)

    def _pass_equal(self, model: Any, count: int, numbers: Int64[np.ndarray, " n"] | None) -> Int64[np.ndarray, " n"]:
        return self._read(model, count).astype(np.int64)

    def _read(self, model: Any, of: np.ndarray | int) -> np.ndarray:
        try:
            return self._decoder.decode(model, of)
        except AssertionError:  # constriction's word for it
            raise not_reproduced() from None


def not_reproduced() -> ScanError:
    """Return the error of a scan that cannot be decoded here."""
    return ScanError(
        "probabilities that are not those of the machine that compressed the scan",
        "the same",
        "decompress where it was compressed, or with the versions that the file names; nothing wrong was written",
    )
