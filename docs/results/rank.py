"""Scores of systems at several budgets → a Markdown table of one metric, with each system's rank at each budget.

    python docs/results/rank.py docs/results/fair/1e13 docs/results/fair/3e13 docs/results/fair/1.5e14_seed1

Each folder holds the scores of one budget, as ``keep_scores.py`` writes them. In brackets stands the rank; = says that
the interval overlaps that of the system one rank before. Systems come in the order of the last budget, then
those that it lacks in the order of the one before.
"""

import argparse
from pathlib import Path

from fair_cells import NAMES, rank_key, read_cell, short


def ranked(folder: Path, metric: str) -> dict[str, str]:
    """Return the value of each system in a folder, with its rank."""
    files = {system: path for system in NAMES if (path := folder / f"{system}.json").exists()}
    found = {system: score for system, path in files.items() if (score := read_cell(path)["scores"].get(metric))}
    if not found:
        raise SystemExit(
            f"got no score by {metric} in {folder}; wanted a folder of docs/results/fair; correct the name"
        )
    cells, before = {}, None
    for rank, (system, score) in enumerate(sorted(found.items(), key=lambda one: rank_key(one[1])), start=1):
        interval = score["interval"]
        apart = before is None or interval["low"] > before["high"] or interval["high"] < before["low"]
        cells[system], before = f"{short(score['value'])}{'' if apart else '='} ({rank})", interval
    return cells


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", help="scores of one budget each, the smallest first")
    parser.add_argument("--metric", default="sliced_wasserstein")
    options = parser.parse_args()
    budgets = [ranked(folder, options.metric) for folder in options.folders]
    # Sorting is stable: the last budget decides, and among systems that it lacks the one before.
    systems = [system for system in NAMES if any(system in budget for budget in budgets)]
    for budget in budgets:
        order = list(budget)
        systems.sort(key=lambda system: order.index(system) if system in order else len(order))
    print("| system | " + " | ".join(folder.name for folder in options.folders) + " |")
    print("|---|" + "---|" * len(budgets))
    for system in systems:
        print(f"| {NAMES[system]} | " + " | ".join(budget.get(system, "") for budget in budgets) + " |")


if __name__ == "__main__":
    main()
