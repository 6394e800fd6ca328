"""Choices that come out the same in every run: seeds derived from seeds, evenly spaced subsets, the order of files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from lidargrit.core.untrusted import SEED_AT_MOST


def derive_seed(*parts: int) -> int:
    """Mix whole numbers into one seed; neighbouring numbers give unrelated seeds.

    Args:
        parts: numbers of 0 or more that name one use of randomness, such as a preset's seed and a step. Zeros at the
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


def natural_order(path: Path) -> tuple[tuple[tuple[int | str, ...], ...], str]:
    """Return what a path is sorted by: 10 comes after 9, so that scans without leading zeros are in order of time.

    Example:
        >>> [path.name for path in sorted([Path("10.bin"), Path("9.bin"), Path("010.bin")], key=natural_order)]
        ['9.bin', '010.bin', '10.bin']
    """
    parts = (re.split("([0-9]+)", part) for part in path.parts)  # text and numbers in turn, so that they compare
    keys = tuple(tuple(int(one) if at % 2 else one for at, one in enumerate(part)) for part in parts)
    return keys, str(path)
