"""Pictures of scans: range images → PNG."""

from lidargrit.viewer.pictures import draw_comparison
from lidargrit.viewer.progress import draw_progress
from lidargrit.viewer.side_by_side import view

__all__ = ["draw_comparison", "draw_progress", "view"]
