"""Whole numbers without an order that tells of them ⇄ decisions: cells of a grid as an octree, and small integers."""

import numpy as np
from jaxtyping import Int64

from lidargrit.inference.compress.adaptive import Counts
from lidargrit.inference.compress.coder import ONE, Coder, not_reproduced

BITS_AT_MOST = 20  # of a cell's number along each axis: three of them fit into 64 bits
_AT_ONCE = 1024  # nodes that are coded by what was learned before them
_LONGEST = 40  # bits of a whole number


def code_cells(coder: Coder, bits: int, count: int, cells: Int64[np.ndarray, "n 3"] | None) -> Int64[np.ndarray, "n 3"]:
    """Code or decode cells, some perhaps several times, in the order of :func:`order_of_cells`.

    Args:
        bits: bits of a cell's number along each axis.
        count: number of cells.
        cells: cells in that order; None to decode.
    """
    codes = None if cells is None else _interleaved(cells, bits)
    nodes = np.zeros(1, dtype=np.int64)
    for level in range(bits):
        below = None if codes is None else np.unique(codes >> 3 * (bits - 1 - level))
        counts, children = Counts(256), list[np.ndarray]()
        for first in range(0, len(nodes), _AT_ONCE):
            some = nodes[first : first + _AT_ONCE]
            tree = np.ones(len(some), dtype=np.int64)
            for child in range(8):
                there = None if below is None else np.isin(some * 8 + child, below, assume_unique=True)
                tree = tree * 2 + counts.code(coder, tree, there)
            which, child = np.nonzero(tree[:, None] >> np.arange(7, -1, -1) & 1)
            children.append(some[which] * 8 + child)
        nodes = np.concatenate(children)
        if not 0 < len(nodes) <= count:
            raise not_reproduced()
    times = None if codes is None else np.unique(codes, return_counts=True)[1] - 1
    times = code_numbers(coder, len(nodes), times) + 1
    if times.min() < 1 or times.max() > count or int(times.sum()) != count:
        raise not_reproduced()
    return _apart(np.repeat(nodes, times), bits)


def order_of_cells(cells: Int64[np.ndarray, "n 3"], bits: int) -> Int64[np.ndarray, " n"]:
    """Return the order in which cells are coded: along a curve that fills space."""
    return np.argsort(_interleaved(cells, bits), kind="stable")


def code_numbers(coder: Coder, count: int, numbers: Int64[np.ndarray, " n"] | None) -> Int64[np.ndarray, " n"]:
    """Code or decode whole numbers from 0, of which the small ones are common."""
    counts, found = Counts(_LONGEST + 1), list[np.ndarray]()
    for first in range(0, count, _AT_ONCE):
        known = None if numbers is None else numbers[first : first + _AT_ONCE] + 1
        size = min(_AT_ONCE, count - first)
        length, going = np.zeros(size, dtype=np.int64), np.arange(size)
        while len(going):  # the number of bits, one by one
            more = counts.code(coder, length[going], None if known is None else known[going] >> length[going] > 1)
            going = going[more]
            length[going] += 1
            if length.max() > _LONGEST:
                raise not_reproduced()
        value = np.ones(size, dtype=np.int64)
        for bit in range(int(length.max()) - 1, -1, -1):
            has = np.flatnonzero(length > bit)
            outcome = None if known is None else known[has] >> bit & 1 == 1
            value[has] = value[has] * 2 + coder.decisions(np.full(len(has), ONE // 2), outcome)
        found.append(value - 1)
    return np.concatenate([np.zeros(0, dtype=np.int64), *found])


def _interleaved(cells: Int64[np.ndarray, "n 3"], bits: int) -> Int64[np.ndarray, " n"]:
    code = np.zeros(len(cells), dtype=np.int64)
    for bit in range(bits - 1, -1, -1):
        for axis in range(3):
            code = code << 1 | cells[:, axis] >> bit & 1
    return code


def _apart(codes: Int64[np.ndarray, " n"], bits: int) -> Int64[np.ndarray, "n 3"]:
    cells = np.zeros((len(codes), 3), dtype=np.int64)
    for bit in range(bits):
        for axis in range(3):
            cells[:, axis] |= (codes >> 3 * bit + 2 - axis & 1) << bit
    return cells
