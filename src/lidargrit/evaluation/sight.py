"""Which metrics see known damages of streets, with how many scans: a table that benchmarks/damages.py measures."""

import csv
from collections.abc import Iterator
from functools import cache
from importlib import resources
from typing import Final

DEVIATIONS: Final = 2.8
"""Standard deviations beyond which a difference is no chance: Student's 97.5 % quantile for five halvings."""

_TABLE = "sight.csv"


def blind_to(metric: str, variant: str, scans: int) -> tuple[str, ...] | None:
    """Return the damages that a metric would not have seen; None for a metric that was not measured.

    The damages are ranges blurred over three columns, every second vehicle removed, and boxes in place of vehicles; of
    streets of 64x256. What was seen with fewer scans is seen with more.

    Args:
        scans: number of scans of each set.
    """
    damages = _measured().get((metric, variant))
    if damages is None:
        return None
    return tuple(name for name, fewest in damages.items() if fewest is None or fewest > scans)


@cache
def _measured() -> dict[tuple[str, str], dict[str, int | None]]:
    """Return for each metric and variant the fewest scans with which each damage was seen; None if with none."""
    found: dict[tuple[str, str], dict[str, int | None]] = {}
    for row in sorted(_rows(), key=lambda row: int(row["scans"])):
        damages = found.setdefault((row["metric"], row["variant"]), {})
        if damages.setdefault(row["damage"], None) is None and float(row["deviations"]) > DEVIATIONS:
            damages[row["damage"]] = int(row["scans"])
    return found


def _rows() -> Iterator[dict[str, str]]:
    text = resources.files("lidargrit.evaluation").joinpath(_TABLE).read_text(encoding="utf-8")
    yield from csv.DictReader(text.splitlines())
