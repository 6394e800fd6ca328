"""Range images of firings ⇄ decisions, by probabilities that are learned from the pixels before, with no network.

All rows are coded at once, each some columns behind the row above, so that a pixel knows its row's earlier pixels and
those above it on both sides. The range's distribution is a mixture over predictions from these neighbours (the last
range, a line through two, the range above, ...); weights and widths of the parts are those that did best so far in
pixels of like neighbours. Only operations are used whose results IEEE 754 fixes.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from lidargrit.inference.compress.coder import ONE, Coder
from lidargrit.inference.compress.rounding import sigmoid

_BEHIND = 3  # columns that a row is behind the row above
_MARGIN = 8
_FINE = 128  # entries of the table of the logistic function for each of its units
_REACH = 16
_LOGISTIC = sigmoid(np.arange(-_REACH * _FINE, _REACH * _FINE + 2) / _FINE)
_RISE = np.append(_LOGISTIC[1:] - _LOGISTIC[:-1], 0.0)
_WIDTHS_M = np.array([0.01, 0.05, 0.02, 0.1, 0.03, 0.2, 0.05, 0.3, 0.5, 3.0])  # of the parts, before any pixel
_ROUGHNESS_M = np.array([0.008, 0.015, 0.025, 0.04, 0.08, 0.2, 0.6])
_DISAGREEMENT_M = np.array([0.015, 0.03, 0.08, 0.3, 1.0, 4.0, 10.0])
_CLASSES = (len(_ROUGHNESS_M) + 1) * (len(_DISAGREEMENT_M) + 1)
_MEMORY = 300.0  # pixels of a class that its weights and widths are means of
_LEAST_WEIGHT, _LEAST_WIDTH_M = 1e-4, 0.002
_ANYWHERE = 1e-4  # probability of a range that has nothing to do with its neighbours
_COUNTED = 1 << 14
_ADDED = 5  # counts of one outcome; the more, the sooner is a new context believed
_START_M = 20.0
_NEAREST_M = 0.1  # as predictions have it, which divide by distances
_WIDTHS = 1.386  # mean absolute deviation of a logistic distribution of scale 1: 2 ln 2
_MASK_NEIGHBOURS = ((0, -1), (0, -2), (-1, 0), (-1, 1), (-1, -1), (-2, 0), (0, -3), (-1, 2), (-2, 1), (0, -4))


class Grid(NamedTuple):
    """Steps in which each pixel's distance is counted.

    Args:
        step_m: (K, n).
        bits: bits of a number of steps.
    """

    step_m: Float64[np.ndarray, "K n"]
    bits: int


class Counts:
    """How often decisions were True so far, by their context, from which comes the probability of the next ones.

    Args:
        contexts: number of contexts.
    """

    def __init__(self, contexts: int) -> None:
        self._counts = np.full((contexts, 2), 2, dtype=np.int64)

    def code(
        self, coder: Coder, context: Int64[np.ndarray, " m"], outcome: Bool[np.ndarray, " m"] | None
    ) -> Bool[np.ndarray, " m"]:
        """Code or decode decisions, all by what was known before them; ``outcome`` is None to decode."""
        counts = self._counts[context]
        found = coder.decisions(counts[:, 1] * ONE // (counts[:, 0] + counts[:, 1]), outcome)
        np.add.at(self._counts, (context, found.astype(np.int64)), _ADDED)
        many = context[self._counts[context].sum(1) > _COUNTED]
        if len(many):  # what is long ago counts less
            self._counts[many] = (self._counts[many] + 1) // 2
        return found


class _Tables:
    """What was learned of the parts of mixtures, by the class of a pixel's neighbours."""

    def __init__(self) -> None:
        parts = len(_WIDTHS_M)
        self.weight = np.full((parts, _CLASSES), 1 / parts)
        self.width_m = np.repeat(_WIDTHS_M[:, None], _CLASSES, 1)
        self._seen = np.full(_CLASSES, 5.0)
        self._shares = np.full((parts, _CLASSES), 3.0)

    def learn(self, of: Int64[np.ndarray, " m"], part: Float64[np.ndarray, "P m"], off_m: np.ndarray) -> None:
        """Learn from pixels of which ``part`` is the share of each part in their probability."""
        np.add.at(self._seen, of, 1.0)
        rate = 1 / np.minimum(self._seen[of], _MEMORY)
        for p in range(len(part)):
            np.add.at(self._shares[p], of, part[p])
        rates = part / np.minimum(self._shares[:, of], _MEMORY)
        weight, width_m = self.weight[:, of], self.width_m[:, of]
        for p in range(len(part)):
            np.add.at(self.weight[p], of, rate * (part[p] - weight[p]))
            np.add.at(self.width_m[p], of, rates[p] * (off_m[p] - width_m[p]))
        np.maximum(self.weight, _LEAST_WEIGHT, out=self.weight)
        np.maximum(self.width_m, _LEAST_WIDTH_M, out=self.width_m)


class _Mixture:
    """The distribution of the number of steps of each of m pixels.

    Args:
        of: class of each pixel.
        centre_m: distance that each part expects.
    """

    def __init__(
        self,
        tables: _Tables,
        of: Int64[np.ndarray, " m"],
        centre_m: Float64[np.ndarray, "P m"],
        step_m: Float64[np.ndarray, " m"],
        bits: int,
    ) -> None:
        self._centre_m, self._step_m, self._evenly = centre_m, step_m, _ANYWHERE / (1 << bits)
        self._inverse = _FINE * _WIDTHS / tables.width_m[:, of]
        self._weight = tables.weight[:, of]

    def parts_below(self, index: Int64[np.ndarray, " m"]) -> Float64[np.ndarray, "P m"]:
        """Return each part's distribution function at the lower border of the step ``index``, times its weight."""
        edge_m = (index - 0.5) * self._step_m
        at = (edge_m - self._centre_m) * self._inverse + _REACH * _FINE
        at = np.minimum(np.maximum(at, 0.0), 2.0 * _REACH * _FINE)
        whole = at.astype(np.int64)
        return self._weight * (_LOGISTIC[whole] + (at - whole) * _RISE[whole])

    def below(self, index: Int64[np.ndarray, " m"]) -> Float64[np.ndarray, " m"]:
        """Return the distribution function, times a constant, at the lower border of the step ``index``."""
        # Accumulated, parts are added one after the other; a sum over an axis is ordered as a machine likes.
        return np.add.accumulate(self.parts_below(index), 0)[-1] + index * self._evenly


class _Rows:
    """What is known of the image while it is coded."""

    def __init__(self, shape: tuple[int, int]) -> None:
        rows, columns = shape
        padded = rows + 2, columns + 2 * _MARGIN  # two rows above, and columns on both sides, in which nothing returns
        self.mask, self.filled_m = np.zeros(padded, dtype=bool), np.zeros(padded)
        self.steps = np.zeros(shape, dtype=np.int64)
        self.last_m, self.last_but_one_m = np.full(rows, _START_M), np.full(rows, _START_M)
        self.rough_m = np.full(rows, 0.1)

    def around(self, row: np.ndarray, column: np.ndarray) -> Int64[np.ndarray, " m"]:
        """Return which neighbours returned, as bits of a number."""
        bits = np.zeros(len(row), dtype=np.int64)
        for bit, (down, right) in enumerate(_MASK_NEIGHBOURS):
            bits += self.mask[row + 2 + down, column + _MARGIN + right].astype(np.int64) << bit
        return bits

    def expected(self, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the class of each pixel, and the distances that the parts of its mixture expect."""
        left, before = self.last_m[row], self.last_but_one_m[row]
        above, at = self.filled_m, column + _MARGIN
        up = above[row + 1, at]
        up = np.where(up > 0, up, left)
        up_left, up_up = above[row + 1, at - 1], above[row, at]
        up_left, up_up = np.where(up_left > 0, up_left, up), np.where(up_up > 0, up_up, up)
        # On a plane the inverse of the range is nearly linear in the angle.
        line = 1 / np.clip(2 / left - 1 / before, 0.5 / left, 2 / left)
        like_above = left * up / up_left
        both = 2 / (1 / line + 1 / like_above)
        centre_m = np.stack([both, both, line, line, like_above, like_above, left, left, up, both])
        rough = np.searchsorted(_ROUGHNESS_M, self.rough_m[row], "right")
        apart = np.searchsorted(_DISAGREEMENT_M, np.abs(line - like_above), "right")
        return rough * (len(_DISAGREEMENT_M) + 1) + apart, centre_m


def code_image(
    coder: Coder, grid: Grid, known: Int64[np.ndarray, "K n"] | None
) -> tuple[Bool[np.ndarray, "K n"], Int64[np.ndarray, "K n"]]:
    """Code or decode where something returned, and the distance of each return in steps.

    Args:
        known: number of steps of each pixel, -1 where nothing returned; None to decode.
    """
    shape = rows, columns = grid.step_m.shape
    image, tables = _Rows(shape), _Tables()
    returned = Counts(1 << len(_MASK_NEIGHBOURS))
    for time in range(columns + _BEHIND * (rows - 1)):
        row = np.arange(max(0, -((columns - 1 - time) // _BEHIND)), min(rows, time // _BEHIND + 1))
        column = time - _BEHIND * row
        outcome = None if known is None else known[row, column] >= 0
        mask = returned.code(coder, image.around(row, column), outcome)
        image.mask[row + 2, column + _MARGIN] = mask
        if mask.any():
            steps = None if known is None else known[row[mask], column[mask]]
            _code_distances(coder, grid, (image, tables), (row[mask], column[mask]), steps)
        image.filled_m[row + 2, column + _MARGIN] = image.last_m[row]
    return image.mask[2:, _MARGIN:-_MARGIN], image.steps


def _code_distances(
    coder: Coder,
    grid: Grid,
    learned: tuple[_Rows, _Tables],
    at: tuple[np.ndarray, np.ndarray],
    known: Int64[np.ndarray, " m"] | None,
) -> None:
    """Code or decode the distances of pixels of different rows, and learn from them."""
    (image, tables), (row, column), step_m = learned, at, grid.step_m[at]
    of, centre_m = image.expected(row, column)
    mixture = _Mixture(tables, of, centre_m, step_m, grid.bits)
    steps = _code_steps(coder, mixture, (len(row), grid.bits), known)
    part = mixture.parts_below(steps + 1) - mixture.parts_below(steps)
    part = part / np.maximum(np.add.accumulate(part, 0)[-1], 1e-30)
    distance_m = steps * step_m
    tables.learn(of, part, np.maximum(np.abs(distance_m - centre_m), 0.25 * step_m))
    off_m = np.minimum(np.abs(distance_m - centre_m[0]), 1.0)
    image.rough_m[row] += 0.3 * (off_m - image.rough_m[row])
    image.steps[at] = steps
    image.last_but_one_m[row] = image.last_m[row]
    image.last_m[row] = np.maximum(distance_m, _NEAREST_M)


def _code_steps(
    coder: Coder, mixture: _Mixture, size: tuple[int, int], known: Int64[np.ndarray, " m"] | None
) -> Int64[np.ndarray, " m"]:
    """Code or decode numbers of steps by halving the interval again and again."""
    count, bits = size
    low = np.zeros(count, dtype=np.int64)
    below, above = mixture.below(low), mixture.below(low + (1 << bits))
    for bit in range(bits - 1, -1, -1):
        middle = low + (1 << bit)
        at_middle = mixture.below(middle)
        share = np.rint((above - at_middle) / (above - below) * ONE).astype(np.int64)
        upper = coder.decisions(share, None if known is None else known >= middle)
        low = np.where(upper, middle, low)
        below, above = np.where(upper, at_middle, below), np.where(upper, above, at_middle)
    return low
