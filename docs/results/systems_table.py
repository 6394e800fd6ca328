"""Scores of systems, trained with one or more seeds → a Markdown table: systems by metrics.

    python docs/results/systems_table.py docs/results/fair/1.5e14_seed0 docs/results/fair/1.5e14_seed1

Each folder holds the scores of one seed, as ``keep_scores.py`` writes them. A value is the mean over the seeds, and its
interval reaches from the lowest bound of their intervals over scans to the highest.
Systems come in the order of ``sliced_wasserstein``. Bold: the nearest of the trained systems, if its interval overlaps
with none of theirs.
"""

import argparse
import json
import statistics
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

from plot_budgets import NAMES

BOUNDS = {"marginal": "`marginal`", "memorised": "`memorised`"}  # not trained
ORDER_BY = "sliced_wasserstein"
DEFAULT = ("sliced_wasserstein", "bev_jsd", "point_cloud_jsd", "range_histogram_per_ring", "return_rate_per_ring")


class Cell(NamedTuple):
    """A score over all seeds of a system."""

    value: float
    low: float
    high: float

    def text(self, bold: bool) -> str:
        """Return value and interval."""
        value = f"**{short(self.value)}**" if bold else short(self.value)
        return f"{value} [{short(self.low)}, {short(self.high)}]"


def short(value: float) -> str:
    """Return a score with three decimals, or two digits if it is smaller than they can tell."""
    return f"{value:.1e}".replace("e-0", "e-") if 0 < abs(value) < 0.0005 else f"{value:.3f}".replace("0.", ".", 1)


def read(folders: list[Path]) -> tuple[dict[str, int], dict[str, dict[str, Cell]], dict[str, float]]:
    """Return the number of seeds of each system, the cells by metric and system, and real against real by metric."""
    seeds: dict[str, int] = {}
    cells: dict[str, dict[str, Cell]] = defaultdict(dict)
    real = {}
    for system in [*NAMES, *BOUNDS]:
        files = [path for folder in folders if (path := folder / f"{system}.json").exists()]
        scores = [score for path in files for score in json.loads(path.read_text(encoding="utf-8"))["scores"]]
        seeds |= {system: len(files)} if files else {}
        real |= {score["metric"]: score["real_against_real"]["value"] for score in scores}
        for metric in {score["metric"] for score in scores}:
            of = [score for score in scores if score["metric"] == metric]
            low, high = (f(score["interval"][end] for score in of) for f, end in ((min, "low"), (max, "high")))
            cells[metric][system] = Cell(statistics.mean(score["value"] for score in of), low, high)
    return seeds, cells, real


def nearest(cells: dict[str, Cell]) -> str:
    """Return the trained system that is nearer than all others with intervals apart, or nothing."""
    first, *others = sorted((cell, system) for system, cell in cells.items() if system not in BOUNDS)
    return first[1] if all(first[0].high < cell.low for cell, _ in others) else ""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", help="scores of one seed each")
    parser.add_argument("--metrics", nargs="+", default=DEFAULT)
    options = parser.parse_args()
    seeds, cells, real = read(options.folders)
    bold = {metric: nearest(cells[metric]) for metric in options.metrics}
    trained = sorted(seeds.keys() - BOUNDS.keys(), key=lambda system: cells[ORDER_BY][system])
    print(f"| lower is better | seeds | {' | '.join(f'`{metric}`' for metric in options.metrics)} |")
    print("|---|---|" + "---|" * len(options.metrics))
    for system in [*trained, *(system for system in BOUNDS if system in seeds)]:
        of = [(cells[metric].get(system), bold[metric] == system) for metric in options.metrics]
        row = [cell.text(is_bold) if cell else "not applicable" for cell, is_bold in of]
        print(f"| {(NAMES | BOUNDS)[system]} | {seeds[system]} | {' | '.join(row)} |")
    print(f"| real against real | | {' | '.join(short(real[metric]) for metric in options.metrics)} |")


if __name__ == "__main__":
    main()
