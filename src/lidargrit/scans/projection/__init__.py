"""Between scans and range images: project, unproject, and the encodings of range that networks see."""

from lidargrit.scans.projection.encoding import EncodingName, RangeEncoding
from lidargrit.scans.projection.image import index_map, points_of_pixels, project, project_by_what_fits, unproject
from lidargrit.scans.projection.inspection import inspect
from lidargrit.scans.projection.pixel_coordinates import ProjectionVariant, variant_named
from lidargrit.scans.projection.sensor_check import projection_that_fits

__all__ = [
    "EncodingName",
    "RangeEncoding",
    "ProjectionVariant",
    "index_map",
    "inspect",
    "points_of_pixels",
    "project",
    "project_by_what_fits",
    "projection_that_fits",
    "unproject",
    "variant_named",
]
