"""Points of a scan → their row, column and range in the image, and the nearest point of each pixel."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float32, Int, Int32

from lidargrit.core.errors import ConfigError, one_of
from lidargrit.scans.projection import spherical, unfolding
from lidargrit.scans.sensors import ProjectionName, SensorModel
from lidargrit.scans.types import Scan

ProjectionVariant = Literal["exact", "reference", "clamped"]

_ROUNDING = 2.0**-20  # of a range: more than squares, sums and roots of coordinates of 32 bits lose


@dataclass(frozen=True, eq=False)
class PixelCoordinates:
    """The row, the column and the range of every point, before any point is left out.

    Args:
        row: row index (n,) of each point; -1 above all rows, ``height`` or more below them.
        column: index (n,) of each point among the fine columns.
        range_m: Euclidean distance (n,) of each point from the sensor, in metres.
        height: number of rows of the image.
        width: number of fine columns of the image.
    """

    row: Int[np.ndarray, "n"]
    column: Int32[np.ndarray, "n"]
    range_m: Float32[np.ndarray, "n"]
    height: int
    width: int

    def in_rows(self) -> Bool[np.ndarray, "n"]:
        """Return which points have a row."""
        return (self.row >= 0) & (self.row < self.height)

    def nearest(
        self, eligible: Bool[np.ndarray, "n"]
    ) -> tuple[Int32[np.ndarray, "H fine_W"], Float32[np.ndarray, "H fine_W"]]:
        """Find the nearest eligible point of each pixel; of equally near points, the last.

        Every eligible point must have a row.

        Returns:
            index of the nearest point in the scan, -1 where a pixel has none; its range in metres, infinite for none.
        """
        spare = self.height * self.width  # a pixel beyond the image takes the points that are left out
        pixel = self.row.astype(np.int64)
        pixel *= self.width
        pixel += self.column
        pixel[~eligible] = spare
        least_m = np.full(spare + 1, np.inf, dtype=np.float32)
        np.minimum.at(least_m, pixel, self.range_m)
        nearest = np.flatnonzero(self.range_m == least_m.take(pixel))
        point = np.full(spare + 1, -1, dtype=np.int32)
        point[pixel.take(nearest)] = nearest  # of several writes to a pixel the last one stays
        shape = self.height, self.width
        return point[:spare].reshape(shape), least_m[:spare].reshape(shape)


def pixel_coordinates(
    scan: Scan, sensor: SensorModel, method: ProjectionName, variant: ProjectionVariant
) -> PixelCoordinates:
    """Find the row, the fine column and the range of every point."""
    for name, value, hint in (("method", method, ProjectionName), ("variant", variant, ProjectionVariant)):
        if value not in get_args(hint):
            raise ConfigError(f"{name}={value!r}", one_of(get_args(hint)), "correct it")
    xyz_m = np.ascontiguousarray(scan.points_xyz_m.numpy().T)  # NumPy is far faster along whole coordinates
    with np.errstate(over="ignore", under="ignore"):
        range_m = xyz_m[0] * xyz_m[0]
        range_m += xyz_m[1] * xyz_m[1]
        range_m += xyz_m[2] * xyz_m[2]
        np.sqrt(range_m, out=range_m)
    height, width = sensor.height, sensor.width * sensor.column_stride
    if variant == "reference":
        if method == "spherical":
            row = spherical.reference_rows(xyz_m, range_m, height)
        else:
            row = unfolding.reference_rings(xyz_m, height)
        return PixelCoordinates(row, unfolding.reference_columns(xyz_m, width), range_m, height, width)
    for limit_m in (sensor.range_min_m, sensor.range_max_m):  # at a limit, coordinates of 32 bits may lie just beyond
        range_m[np.abs(range_m - np.float32(limit_m)) <= _ROUNDING * limit_m] = limit_m
    if method == "spherical":
        row = spherical.rows(xyz_m, range_m, row_elevation_rad(sensor))
    elif scan.ring is not None:
        row = scan.ring.numpy()
    elif scan.filled is None:
        row = unfolding.rings_from_firing_order(xyz_m)
    else:  # points that a model added lie on the rays of rows, and behind the measured ones
        row = spherical.rows(xyz_m, range_m, row_elevation_rad(sensor)).astype(np.int32)
        measured = ~scan.filled.numpy()
        row[measured] = unfolding.rings_from_firing_order(np.ascontiguousarray(xyz_m[:, measured]))
    if variant == "clamped":
        row = row.clip(0, height - 1)
    return PixelCoordinates(row, unfolding.columns(xyz_m, width, sensor.first_edge_rad), range_m, height, width)


def variant_named(name: str) -> ProjectionVariant:
    """Return the variant of the projection that has a name; the exact one for a name of none."""
    return next((variant for variant in get_args(ProjectionVariant) if variant == name), "exact")


def within_limits(range_m: Float32[np.ndarray, "*n"], sensor: SensorModel) -> Bool[np.ndarray, "*n"]:
    """Return which ranges lie within the sensor's limits; the limits themselves are inside."""
    return (range_m >= sensor.range_min_m) & (range_m <= sensor.range_max_m)


def row_elevation_rad(sensor: SensorModel) -> np.ndarray:
    """Return one elevation (H,) for every row: the mean over its pixels, for a sensor with angles for every pixel."""
    return sensor.elevation_rad.mean(dim=1).double().numpy()
