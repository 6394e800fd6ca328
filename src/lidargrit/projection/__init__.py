"""Between scans and range images: project, unproject, and the encodings of range that networks see."""

from lidargrit.projection.encoding import RangeEncoding
from lidargrit.projection.image import Variant, index_map, project
from lidargrit.projection.unproject import points_of_pixels, unproject

__all__ = ["RangeEncoding", "Variant", "index_map", "points_of_pixels", "project", "unproject"]
