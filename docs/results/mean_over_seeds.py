"""Errors of reconstruction of several seeds of several rows → one table: mean over seeds, and what seeds alone change.

    python docs/results/mean_over_seeds.py NAME=SCORES.json,SCORES.json,... [NAME=...]

The files are those of ``lidargrit evaluate RUN SCANS --json``. The interval is Student's, 95 %, over the seeds: with
three of them it is 2.5 standard deviations wide to either side, so what it leaves apart is apart.
"""

import argparse
import json
import math
import statistics
from pathlib import Path

from scipy.stats import t as students

SHOWN = {
    "range_mae_m": "range error [m]",
    "mask_accuracy": "mask accuracy",
    "drop_precision": "drop precision",
    "drop_recall": "drop recall",
    "drop_iou": "drop IoU",
}


def summary(values: list[float]) -> str:
    """Return mean and half the width of the interval."""
    mean, count = statistics.mean(values), len(values)
    if count < 2:
        return f"{mean:.3f}"
    half = students.ppf(0.975, count - 1) * statistics.stdev(values) / math.sqrt(count)
    return f"{mean:.3f} ± {half:.3f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="+", metavar="NAME=FILES")
    print(f"| | seeds | {' | '.join(SHOWN.values())} |")
    print("|---|---|" + "---|" * len(SHOWN))
    for row in parser.parse_args().rows:
        name, _, files = row.partition("=")
        found = [json.loads(Path(file).read_text(encoding="utf-8"))["reconstruction"] for file in files.split(",")]
        cells = [summary([errors[error] for errors in found]) for error in SHOWN]
        print(f"| {name} | {len(found)} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
