"""Scores of systems at several budgets → lines over the operations of training, and points over seconds a scan.

    python docs/results/plot_budgets.py budgets.png docs/results/fair/1e13 docs/results/fair/1.5e14_of64

Each folder holds the scores of one budget, as ``keep_scores.py`` writes them; all must compare equally many scans,
since scores of fewer scans are higher. A system with one budget is a point. Bars are the intervals over scans. Over
seconds stands a system's largest budget, with an open marker if others had a larger one.
"""

import argparse
import io
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

from fair_cells import NAMES, read_cell
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from PIL import Image

METRICS = ("sliced_wasserstein", "point_cloud_jsd", "range_histogram_per_ring", "return_rate_per_ring")
MARKERS = "osD^v8<>PX*hdpH12x"
COLOURS = colormaps["tab20"].colors[: len(MARKERS)]  # one for each name


class Cell(NamedTuple):
    """One score of one system at one budget."""

    flops: float
    seconds: float
    value: float
    low: float
    high: float
    floor: float


def read(folders: list[Path]) -> dict[str, dict[str, list[Cell]]]:
    """Return the cells by metric and system, by increasing budget.

    Raises:
        SystemExit: scores of different numbers of scans.
    """
    cells: dict[str, dict[str, list[Cell]]] = defaultdict(lambda: defaultdict(list))
    counts = set()
    for path in sorted(path for folder in folders for path in folder.glob("*.json") if path.stem in NAMES):
        of = read_cell(path)
        counts.add(of["inputs"]["samples"]["scans_used"])
        for metric, score in of["scores"].items():
            about = score["interval"]["low"], score["interval"]["high"], score["real_against_real"]["value"]
            costs = of["costs"]["training_flops"], of["costs"]["seconds_per_scan"]
            cells[metric][path.stem].append(Cell(*costs, score["value"], *about))
    if len(counts) != 1:
        raise SystemExit(f"got scores of {sorted(counts)} scans; wanted those of equally many; score them again")
    return {metric: {name: sorted(of) for name, of in systems.items()} for metric, systems in cells.items()}


def lines(axis: Axes, systems: dict[str, list[Cell]], by: str) -> None:
    """Plot each system over one cost."""
    most_flops = max(cell.flops for found in systems.values() for cell in found)
    for number, (system, name) in enumerate(NAMES.items()):
        found = systems.get(system, [])
        if by == "seconds":
            found = found[-1:]
        if not found:
            continue
        values = [cell.value for cell in found]
        bars = [[c.value - c.low for c in found], [c.high - c.value for c in found]]
        costs = [getattr(cell, by) for cell in found]
        look = {"color": COLOURS[number], "marker": MARKERS[number], "ms": 5, "lw": 1}
        if by == "seconds" and found[-1].flops < most_flops / 2:
            look["mfc"] = "none"
        axis.errorbar(costs, values, bars, label=name, **look)
    axis.axhline(next(iter(systems.values()))[0].floor, color="grey", ls=":", lw=1, label="real against real")
    axis.set(xscale="log", yscale="log")
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_locator(LogLocator(subs=(2, 5)))
    axis.yaxis.set_minor_formatter("{x:g}")
    axis.grid(alpha=0.3)


def main() -> None:
    """Plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("png", type=Path)
    parser.add_argument("folders", type=Path, nargs="+")
    options = parser.parse_args()
    cells = read(options.folders)
    figure = Figure(figsize=(13, 6.4), layout="constrained", dpi=72)
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(METRICS))
    for column, metric in enumerate(METRICS):
        lines(axes[0, column], cells[metric], "flops")
        lines(axes[1, column], cells[metric], "seconds")
        axes[0, column].set(title=metric, xlabel="operations of training")
        axes[1, column].set(xlabel="seconds a scan, one core")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False)
    drawn = io.BytesIO()
    figure.savefig(drawn)
    Image.open(drawn).convert("RGB").quantize(128).save(options.png, optimize=True)


if __name__ == "__main__":
    main()
