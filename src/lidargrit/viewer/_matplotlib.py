"""Imports matplotlib so that it obeys no ``matplotlibrc`` of the current folder; figures → PNG.

matplotlib looks there first, and such a file may have it run LaTeX, or spoil every picture. The user's own file, in the
home folder, counts as ever.
"""

import os
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from lidargrit.core.files import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DOTS_PER_INCH = 100  # 1400 pixels across: a laptop shows the picture without shrinking it

if "matplotlib" not in sys.modules:
    _current = os.open(".", os.O_RDONLY)
    try:
        os.chdir(Path(__file__).parent)
        import matplotlib  # noqa: F401  its settings are read here, once
    finally:
        os.fchdir(_current)
        os.close(_current)


def write_png(figure: "Figure", path: Path) -> None:
    """Write a figure as PNG; an older picture there is replaced in one step.

    Titles that hold names of files, sensors or sets have ``parse_math=False``: between two dollar signs matplotlib
    would take them for formulas. Of letters that its font lacks, as in many languages, it draws boxes.
    """
    with atomic_path(path) as unfinished, warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"Glyph .* missing from")
        figure.savefig(unfinished, format="png", dpi=_DOTS_PER_INCH)
