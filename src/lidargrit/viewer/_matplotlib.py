"""Imports matplotlib so that it obeys no ``matplotlibrc`` of the current folder.

matplotlib looks there first, and such a file may have it run LaTeX, or spoil every picture. The user's own file, in the
home folder, counts as ever.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

if "matplotlib" not in sys.modules:
    _current = os.open(".", os.O_RDONLY)
    try:
        os.chdir(Path(__file__).parent)
        import matplotlib  # noqa: F401  its settings are read here, once
    finally:
        os.fchdir(_current)
        os.close(_current)
