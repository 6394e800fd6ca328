"""Pictures of scans: range images → PNG."""

from lidargrit.viewer.pictures import draw_comparison

__all__ = ["draw_comparison"]
