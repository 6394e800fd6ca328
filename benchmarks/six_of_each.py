"""Folders of samples, runs or any sources of scans → one picture: six scans of each, the first ones, on one scale.

    python benchmarks/six_of_each.py six.png real=/data/held_out LidarGRIT=table/small/samples runs/mine

A name before an equals sign stands in the picture in place of the folder's. Colours tell ranges from 2 to 80 m; a
pixel without a return is white. Nothing is chosen: of samples those of the lowest seeds are shown.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from lidargrit.evaluation.comparison import EvalConfig, open_pair
from lidargrit.generators import is_run, load, locate
from lidargrit.sources import open_source

NEAR_M, FAR_M = 2.0, 80.0


def ranges_of(words: str, reference: str, count: int) -> tuple[str, np.ndarray]:
    """Return the name of a source and the ranges of its first scans in metres, (count, H, W), 0 without a return."""
    name, _, path = words.rpartition("=")
    if is_run(locate(path)):
        return name or Path(path).name, load(path).sample(range(count)).range_m.numpy()
    pair = open_pair(open_source(path), open_source(reference), EvalConfig(max_scans=count))
    given = Path(path)
    name = name or (given.parent.name if given.name == "samples" else given.name)
    return name, pair.samples.batch(list(range(count))).range_m.numpy()


def plot(rows: list[tuple[str, np.ndarray]], path: Path) -> None:
    """Plot a row of range images for each source."""
    count, size = len(rows[0][1]), rows[0][1].shape[1:]
    across = 2.4
    figure = Figure(figsize=(across * count + 1.6, (across * size[0] / size[1] * 1.5 + 0.06) * len(rows) + 0.2), dpi=72)
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(rows), count, squeeze=False, gridspec_kw={"wspace": 0.03, "hspace": 0.08})
    for axes, (name, ranges_m) in zip(grid, rows, strict=True):
        for cell, range_m in zip(axes, ranges_m, strict=True):
            seen = np.where(range_m > 0, range_m, np.nan)
            cell.imshow(seen, cmap="turbo", norm=LogNorm(NEAR_M, FAR_M), aspect="auto", interpolation="none")
            cell.set(xticks=[], yticks=[])
        axes[0].set_ylabel(name, rotation=0, ha="right", va="center", fontsize=10)
    figure.subplots_adjust(left=1.55 / figure.get_figwidth(), right=0.998, top=0.995, bottom=0.005)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("sources", nargs="+", metavar="[NAME=]SOURCE", help="the first is the reference for the others")
    parser.add_argument("-n", type=int, default=6, help="number of scans of each")
    options = parser.parse_args()
    reference = options.sources[0].rpartition("=")[2]
    plot([ranges_of(words, reference, options.n) for words in options.sources], options.out)


if __name__ == "__main__":
    main()
