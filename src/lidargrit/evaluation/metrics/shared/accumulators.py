"""Accumulators of a metric: summaries of batches → one summary of a set, which can be merged from parts."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Generic, TypeVar

import numpy as np

Kept = TypeVar("Kept")


class Accumulator(ABC, Generic[Kept]):
    """Collects the summaries of one set of images; what is added is never changed."""

    @abstractmethod
    def add(self, summary: np.ndarray) -> None:
        """Take in the summary of a batch of at least one image."""

    @abstractmethod
    def merge(self, other: "Accumulator[Kept]") -> None:
        """Take in what another accumulator of the same class has collected; the other stays as it is."""

    @abstractmethod
    def value(self) -> Kept:
        """Return everything collected so far, from at least one batch."""

    @abstractmethod
    def arrays(self) -> dict[str, np.ndarray]:
        """Return everything collected, from at least one batch, as arrays by name, for a file."""

    @abstractmethod
    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take what :meth:`arrays` returned in place of what was collected.

        Raises:
            KeyError: an array that is missing.
        """


class RowAccumulator(Accumulator[np.ndarray]):
    """Keeps every row of every summary, one row per image, in the order in which they came."""

    def __init__(self) -> None:
        self._parts: list[np.ndarray] = []

    def add(self, summary: np.ndarray) -> None:
        """Append rows."""
        self._parts.append(summary)

    def merge(self, other: Accumulator[np.ndarray]) -> None:
        """Append the rows of another."""
        assert isinstance(other, RowAccumulator)
        self._parts += other._parts

    def value(self) -> np.ndarray:
        """Return all rows as one array, and keep them as that."""
        if len(self._parts) > 1:
            self._parts = [np.concatenate(self._parts)]
        return self._parts[0]

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the rows."""
        return {"rows": self.value()}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take the rows."""
        self._parts = [arrays["rows"]]


class SumAccumulator(Accumulator[np.ndarray]):
    """Keeps the sum of all summaries, so that memory does not grow with the number of images."""

    def __init__(self) -> None:
        self._total: np.ndarray | None = None

    def add(self, summary: np.ndarray) -> None:
        """Add element by element."""
        self._total = summary if self._total is None else self._total + summary

    def merge(self, other: Accumulator[np.ndarray]) -> None:
        """Add the sum of another."""
        assert isinstance(other, SumAccumulator)
        if other._total is not None:
            self.add(other._total)

    def value(self) -> np.ndarray:
        """Return the sum."""
        assert self._total is not None
        return self._total

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the sum, counts in the smallest whole numbers that hold them: 4,000,000 cells take 4 MB, not 32."""
        total = self.value()
        is_counts = total.dtype == np.int64 and total.size and total.min() >= 0
        return {"total": total.astype(np.min_scalar_type(int(total.max()))) if is_counts else total}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take the sum."""
        total = arrays["total"]
        self._total = total.astype(np.int64) if total.dtype.kind == "u" else total
