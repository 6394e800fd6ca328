"""Choices that come out the same in every run: seeds derived from seeds, and evenly spaced subsets."""

from __future__ import annotations

import numpy as np

from lidargrit.untrusted import SEED_AT_MOST


def derive_seed(*parts: int) -> int:
    """Mix whole numbers into one seed; neighbouring numbers give unrelated seeds.

    Args:
        parts: numbers of 0 or more that name one use of randomness, such as a recipe's seed and a step. Zeros at the
            end do not count: (7, 0) gives the seed of (7,).
    """
    return int(np.random.SeedSequence(parts).generate_state(1, np.uint64)[0] >> np.uint64(1))


def scan_seed(*parts: int) -> int:
    """Mix whole numbers, as :func:`derive_seed` does, into a seed that a generator takes: the last 32 bits of that."""
    return derive_seed(*parts) & SEED_AT_MOST


def evenly_spaced(count: int, total: int) -> list[int]:
    """Return at most ``count`` of ``total`` indices, evenly spaced: neighbours in time are nearly the same scan."""
    count = min(count, total)
    return [index * total // count for index in range(count)]
