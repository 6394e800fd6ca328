"""Folders of samples or sources of scans → one picture: six range images of each, on one scale.

    python benchmarks/six_of_each.py six.png real=/data/held_out LidarGRIT=runs/samples table/r2dm_small/samples

A name before the first equals sign stands in place of the folder's. Colours tell ranges from 2 to 80 m; a
pixel without a return is white. Nothing is chosen: the scans are evenly spaced over each source.
"""

import argparse
import io
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from PIL import Image

from lidargrit.viewer.scan_sets import ScanSet, load_scan_sets

NEAR_M, FAR_M = 2.0, 80.0
WIDTH_IN, HEIGHT_IN, NAME_IN = 2.2, 0.85, 1.7  # of an image, and of the names beside


def plot(sets: list[ScanSet], names: list[str], path: Path) -> None:
    """Plot a row of range images for each source."""
    count, columns = len(sets[0].images), min(scans.images.sensor.width for scans in sets)
    figure = Figure(figsize=(WIDTH_IN * count + NAME_IN, HEIGHT_IN * len(sets)), dpi=72)
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(sets), count, squeeze=False, gridspec_kw={"wspace": 0.03, "hspace": 0.1})
    look = {"cmap": "turbo", "norm": LogNorm(NEAR_M, FAR_M), "aspect": "auto", "interpolation": "none"}
    for axes, scans, name in zip(grid, sets, names, strict=True):
        fine_m = scans.images.range_m.numpy()
        ranges_m = fine_m[..., :: fine_m.shape[-1] // columns]  # of finer images every n-th column, as presets take
        for cell, range_m in zip(axes, ranges_m, strict=True):
            cell.imshow(np.where(range_m > 0, range_m, np.nan), **look)
            cell.set(xticks=[], yticks=[])
        axes[0].set_ylabel(name, rotation=0, ha="right", va="center", fontsize=10)
    figure.subplots_adjust(left=NAME_IN / figure.get_figwidth(), right=0.998, top=0.99, bottom=0.01)
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png")
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.open(drawn).convert("RGB").quantize(48).save(path, optimize=True)  # a third of the size, and looks the same


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("sources", nargs="+", metavar="[NAME=]SOURCE")
    parser.add_argument("-n", type=int, default=6, help="number of scans of each")
    options = parser.parse_args()
    named = [_name_and_source(words) for words in options.sources]
    plot(load_scan_sets([source for _, source in named], options.n), [name for name, _ in named], options.out)


def _name_and_source(words: str) -> tuple[str, str]:
    """Split NAME=SOURCE; a source, whose path may hold an equals sign too, is called as its folder."""
    name, equals, source = words.partition("=")
    if not equals or Path(words).exists():
        return Path(words.removesuffix("/samples")).name, words
    return name, source


if __name__ == "__main__":
    main()
