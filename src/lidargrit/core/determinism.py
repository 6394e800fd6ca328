"""Choices that come out the same in every run: seeds derived from seeds, evenly spaced subsets, the order of files."""

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from lidargrit.core.untrusted import NAME_BYTES_AT_MOST, SEED_AT_MOST

_POINTED = re.compile(r"(?<![0-9.])([0-9]+)\.([0-9]+)(?![0-9]|\.[0-9])")  # 17.04, but no part of 1.2.3
_DIGITS_OF_A_DOUBLE = 17  # that programs print of one, with those before the point
_TIMES_THEIR_COUNT = 10  # the largest of some whole numbers in names, such as every tenth of them


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


def natural_order(paths: Iterable[Path]) -> list[Path]:
    """Sort paths in order of time: 10 comes after 9, and among names that are decimal seconds .36 before .4.

    A number with a point may count the parts of a second (17.04 before 17.1), or number twice (1.9 before 1.10;
    nanoseconds that are not padded). The names in one folder tell together which it is.

    Example:
        >>> [path.name for path in natural_order([Path("10.bin"), Path("9.bin"), Path("010.bin")])]
        ['9.bin', '010.bin', '10.bin']
        >>> [path.name for path in natural_order([Path("17.1.bin"), Path("17.04.bin")])]
        ['17.04.bin', '17.1.bin']
    """
    every = list(paths)
    parts_behind: dict[tuple[str, ...], set[tuple[str, str]]] = {}
    for folder, name in {(path.parts[:at], name) for path in every for at, name in enumerate(path.parts)}:
        parts_behind.setdefault(folder, set()).update(_POINTED.findall(name))
    decimal = {folder for folder, numbers in parts_behind.items() if _are_decimals(numbers)}

    def key(path: Path) -> tuple[tuple[tuple[int | str, ...], ...], str]:
        parts = path.parts
        return tuple(_key_of_name(name, parts[:at] in decimal) for at, name in enumerate(parts)), str(path)

    return sorted(every, key=key)


def _are_decimals(numbers: set[tuple[str, str]]) -> bool:
    """Return whether numbers (before the point, behind it) are decimal fractions, not each a number of its own."""
    behind = {part for _, part in numbers}
    if len({len(part) for part in behind}) < 2:
        return False  # both orders are the same
    if any(part.startswith("0") and len(part) > 1 for part in behind):
        return True  # which a whole number does not
    if any(part.endswith("0") and len(part) > 1 for part in behind):
        return False  # nor do programs that shorten fractions leave a zero there
    if max(len(before + part) for before, part in numbers) > _DIGITS_OF_A_DOUBLE:
        return False  # seconds and whole nanoseconds
    return max(map(int, behind)) > _TIMES_THEIR_COUNT * len(numbers)  # whole numbers would have few gaps


def _key_of_name(name: str, is_decimal: bool) -> tuple[int | str, ...]:
    """Return text and numbers in turn, so that they compare; decimal fractions are made equally long."""
    if is_decimal:
        name = _POINTED.sub(lambda found: f"{found[1]}.{found[2].ljust(NAME_BYTES_AT_MOST, '0')}", name)
    return tuple(int(one) if at % 2 else one for at, one in enumerate(re.split("([0-9]+)", name)))
