"""Whether points are in the frame of the sensor that saw them: coordinates of maps, of cars, and in other units."""

import numpy as np
from jaxtyping import Float64

from lidargrit.core.errors import ScanError
from lidargrit.scans.projection.pixel_coordinates import row_elevation_rad
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import Scan

_FAR_M = 500.0  # in the median: no turning sensor sees half of its points so far away
_NO_LENGTH_M = 1e11  # in the median: ten times as far as any place of a map in millimetres from its origin
_POINTS_MEASURED, _POINTS_AT_LEAST = 4096, 500
_ROWS_AT_LEAST = 8  # fewer do not show a height
_HEIGHTS_M = np.round(np.arange(-3.0, 3.01, 0.02), 2)  # of sensors on cars and robots, up and down
_ON_ROW = 0.1  # of the spacing of rows; by chance a fifth of the points are as near
_FEW_ON_ROWS, MOST_ON_ROWS = 0.6, 0.85
_NOT_BELOW_DEG = -5.0  # from its own place a sensor that looks down to twice as low sees the ground there
_TALL_DEG, _FLAT_DEG = 120.0, 60.0  # that elevations of a turning sensor never and always span less than


def other_frame(scan: Scan) -> ScanError | None:
    """Return the message about points that no turning sensor sees so: of a map, in another unit, or in camera axes."""
    points_m = _some_points(scan, _POINTS_MEASURED)
    far_m = float(np.median(np.linalg.norm(points_m, axis=1)))
    if far_m < _FAR_M:
        return _camera_axes(points_m, scan.source)
    if far_m > _NO_LENGTH_M:
        what = f"points at {far_m:.0e} m in the median in {scan.source}"
        return ScanError(what, "coordinates", "check of which type and in which order the file's numbers are")
    level_m = points_m[:, :2]
    centre_m = float(np.linalg.norm(np.median(level_m, axis=0)))
    spread_m = float(np.median(np.linalg.norm(level_m - np.median(level_m, axis=0), axis=1)))
    if centre_m > spread_m:
        what = f"coordinates of a map in {scan.source} ({far_m / 1000:,.0f} km from the origin)"
        return ScanError(what, "those of a sensor, seen from its place", "subtract the sensor's place from x, y and z")
    what = f"points at {far_m:,.0f} m in the median in {scan.source}"
    return ScanError(what, "metres", "check the unit: divide millimetres by 1,000, centimetres by 100")


def _camera_axes(points_m: Float64[np.ndarray, "n 3"], source: str) -> ScanError | None:
    x, y, z = points_m.T
    as_given, as_camera = (_span_deg(up, np.hypot(*level)) for up, level in ((z, (x, y)), (-y, (z, x))))
    if len(points_m) < _POINTS_AT_LEAST or as_given < _TALL_DEG or as_camera > _FLAT_DEG:
        return None
    what = f"elevations over {as_given:.0f} degrees in {source}, and over {as_camera:.0f} in the axes of a camera"
    return ScanError(what, "x forward, y left, z up", "save z, -x, -y as x, y, z")


def _span_deg(up_m: Float64[np.ndarray, "n"], level_m: Float64[np.ndarray, "n"]) -> float:
    low, high = np.quantile(np.degrees(np.arctan2(up_m, level_m)), (0.01, 0.99))
    return float(high - low)


def _some_points(scan: Scan, at_most: int) -> Float64[np.ndarray, "n 3"]:
    return scan.points_xyz_m[:: max(1, len(scan) // at_most)].double().numpy()


class Heights:
    """How many points of a scan lie on the rows of a sensor, seen from its own place and from elsewhere on its axis.

    Args:
        at_most: number of points that are looked at.
    """

    def __init__(self, scan: Scan, sensor: SensorModel, at_most: int = _POINTS_MEASURED) -> None:
        points_m, rows_deg = _some_points(scan, at_most), np.sort(np.degrees(row_elevation_rad(sensor)))
        self._tell = len(points_m) >= min(at_most, _POINTS_AT_LEAST) and len(rows_deg) >= _ROWS_AT_LEAST
        self._tell = self._tell and bool(np.ptp(rows_deg) >= 1)
        self._z_m, self._level_m = points_m[:, 2], np.hypot(points_m[:, 0], points_m[:, 1])
        self._rows_deg = rows_deg

    def are_own(self) -> bool:
        """Return whether points lie on the rows from the sensor's own place, or too little tells it."""
        return not self._tell or self._share_on_rows(0.0)[0] > _FEW_ON_ROWS

    def best(self) -> tuple[float, float]:
        """Return the share of points on rows from the best height, and that height in metres, up."""
        shares = {float(height_m): self._share_on_rows(float(height_m)) for height_m in _HEIGHTS_M}
        height_m = max(shares, key=shares.__getitem__)
        return shares[height_m][0], height_m

    def lowest_deg(self) -> tuple[float, float]:
        """Return the elevation that 99 % of the points lie above, and that of the lowest row."""
        elevation_deg = np.degrees(np.arctan2(self._z_m, self._level_m))
        return float(np.quantile(elevation_deg, 0.01)), float(self._rows_deg[0])

    def _share_on_rows(self, height_m: float) -> tuple[float, float]:
        """Return the share of points on rows, and by how little points are off in the mean."""
        rows_deg = self._rows_deg
        elevation_deg = np.degrees(np.arctan2(self._z_m - height_m, self._level_m))
        above = np.searchsorted(rows_deg, elevation_deg).clip(1, len(rows_deg) - 1)
        off_deg = np.minimum(np.abs(elevation_deg - rows_deg[above - 1]), np.abs(elevation_deg - rows_deg[above]))
        off = off_deg / (rows_deg[above] - rows_deg[above - 1])
        return float((off < _ON_ROW).mean()), -float(off.mean())


def told_height(scan: Scan, sensor: SensorModel) -> str:
    """Return what a person reads of points that a sensor saw from elsewhere on its axis; "" of others.

    From its own place a sensor's points lie on the elevations of its rows. Where few do, and nearly all after a shift
    of z, the points are in the frame of a car or of the ground; and they may be where none is seen below.
    """
    heights = Heights(scan, sensor)
    if heights.are_own():
        return ""
    share, height_m = heights.best()
    if share < MOST_ON_ROWS:
        lowest_deg, looks_deg = heights.lowest_deg()
        if lowest_deg < _NOT_BELOW_DEG or looks_deg > 2 * _NOT_BELOW_DEG:
            return ""
        what = (
            f"99% of {scan.source} lie above {lowest_deg:.1f} degrees, and {sensor.name} looks down to {looks_deg:.1f}"
        )
        return f"{what}; if z counts from the ground, subtract the sensor's height from it"
    where, cure = ("below", "subtract {:.2f} m from z") if height_m > 0 else ("above", "add {:.2f} m to z")
    what = f"points of {scan.source} are seen from {abs(height_m):.2f} m {where} the sensor ({sensor.name})"
    return f"{what}, of which {share:.0%} would lie on its rows; {cure.format(abs(height_m))}"
