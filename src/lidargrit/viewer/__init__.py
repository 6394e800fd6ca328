"""Pictures and pages of scans: range images → PNG or HTML."""

from lidargrit.viewer import _matplotlib  # noqa: F401  before any other module imports matplotlib
from lidargrit.viewer.pictures import plot_comparison, plot_progress
from lidargrit.viewer.side_by_side import view

__all__ = ["plot_comparison", "plot_progress", "view"]
