"""Scores of systems, trained with one or more seeds → a Markdown table: systems by metrics.

    python docs/results/systems_table.py docs/results/fair/1.5e14_seed0 docs/results/fair/1.5e14_seed1

Each folder holds the scores of one seed, as ``keep_scores.py`` writes them. A value is the mean over the seeds, and its
interval reaches from the lowest bound of their intervals over scans to the highest.
Systems come in the order of ``sliced_wasserstein``. Bold: the nearest of the trained systems, if its interval overlaps
with none of theirs.
"""

import argparse
import statistics
from pathlib import Path
from typing import NamedTuple

from fair_cells import NAMES, read_cell, short

BOUNDS = {"marginal": "`marginal`", "memorised": "`memorised`"}  # not trained
ORDER_BY = "sliced_wasserstein"
DEFAULT = (ORDER_BY, "bev_jsd", "point_cloud_jsd", "range_histogram_per_ring", "return_rate_per_ring")


class Score(NamedTuple):
    """A score over all seeds of a system."""

    value: float
    low: float
    high: float
    higher_is_better: bool

    def text(self, bold: bool) -> str:
        """Return value and interval."""
        value = f"**{short(self.value)}**" if bold else short(self.value)
        return f"{value} [{short(self.low)}, {short(self.high)}]"

    def nearer_than(self, other: "Score") -> bool:
        """Return whether this score is better, with intervals apart."""
        return self.low > other.high if self.higher_is_better else self.high < other.low


def over_seeds(cells: list[dict], metric: str) -> Score | None:
    """Return the score of a system by one metric; None where it has none."""
    of = [cell["scores"][metric] for cell in cells if metric in cell["scores"]]
    if not of:
        return None
    low, high = (f(score["interval"][end] for score in of) for f, end in ((min, "low"), (max, "high")))
    return Score(statistics.mean(score["value"] for score in of), low, high, of[0]["higher_is_better"])


def nearest(scores: dict[str, Score | None]) -> str:
    """Return the trained system that is nearer than all others with intervals apart, or nothing."""
    found = {system: score for system, score in scores.items() if score and system not in BOUNDS}
    for system, score in found.items() if len(found) > 1 else ():
        if all(score.nearer_than(other) for name, other in found.items() if name != system):
            return system
    return ""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", help="scores of one seed each")
    parser.add_argument("--metrics", nargs="+", default=DEFAULT)
    options = parser.parse_args()
    files = {
        name: [f for folder in options.folders if (f := folder / f"{name}.json").exists()] for name in NAMES | BOUNDS
    }
    cells = {system: [read_cell(path) for path in paths] for system, paths in files.items() if paths}
    scores = {metric: {system: over_seeds(of, metric) for system, of in cells.items()} for metric in options.metrics}
    if missing := [metric for metric, of in scores.items() if not any(of.values())]:
        raise SystemExit(f"got --metrics {missing[0]}, of which no file has a score; wanted one that they have")
    real = {
        m: score["real_against_real"]["value"] for of in cells.values() for c in of for m, score in c["scores"].items()
    }
    bold = {metric: nearest(scores[metric]) for metric in options.metrics}
    order = {system: over_seeds(of, ORDER_BY) for system, of in cells.items()}
    trained = sorted(cells.keys() - BOUNDS.keys(), key=lambda system: (order[system] is None, order[system]))
    print(f"| | seeds | {' | '.join(f'`{metric}`' for metric in options.metrics)} |")
    print("|---|---|" + "---|" * len(options.metrics))
    for system in [*trained, *(system for system in BOUNDS if system in cells)]:
        of = [(scores[metric][system], bold[metric] == system) for metric in options.metrics]
        row = [score.text(is_bold) if score else "not applicable" for score, is_bold in of]
        print(f"| {(NAMES | BOUNDS)[system]} | {len(cells[system])} | {' | '.join(row)} |")
    print(f"| real against real | | {' | '.join(short(real[metric]) for metric in options.metrics)} |")


if __name__ == "__main__":
    main()
