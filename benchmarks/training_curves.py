"""Run folders → one picture of how each stage learned: its validation loss over the scans that it has seen.

    python benchmarks/training_curves.py RUN [RUN ...] -o curves.png

Losses of different systems have different units and do not compare; the picture shows whether each was still falling.
"""

import argparse
import json
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator


def curves(run: Path) -> dict[str, tuple[list[int], list[float]]]:
    """Return scans seen and validation loss of each stage."""
    found = {}
    for log in sorted(run.glob("*/log.jsonl")):
        lines = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
        val = [line for line in lines if line["split"] == "val"]
        found[f"{run.name}: {log.parent.name}"] = [line["scans_seen"] for line in val], [line["loss"] for line in val]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("-o", "--out", type=Path, required=True)
    options = parser.parse_args()
    found = {name: curve for run in options.runs for name, curve in curves(run).items()}
    figure = Figure(figsize=(3.2 * len(found), 2.8), dpi=90)
    FigureCanvasAgg(figure)
    for number, (name, (scans, losses)) in enumerate(found.items(), 1):
        axes = figure.add_subplot(1, len(found), number)
        axes.plot(scans, losses, color="#26323c")
        axes.set_title(name, fontsize=9)
        axes.set_xlabel("scans seen", fontsize=8)
        axes.tick_params(labelsize=7)
        axes.xaxis.set_major_locator(MaxNLocator(3))
    figure.tight_layout()
    figure.savefig(options.out)


if __name__ == "__main__":
    main()
