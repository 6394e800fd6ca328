"""Pictures of scans: range images → PNG."""

from lidargrit.viewer.pictures import plot_comparison
from lidargrit.viewer.progress import plot_progress
from lidargrit.viewer.side_by_side import view

__all__ = ["plot_comparison", "plot_progress", "view"]
