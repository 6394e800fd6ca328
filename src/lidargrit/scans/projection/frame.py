"""Whether points are in the frame of the sensor that saw them: coordinates of maps, of cars, and in other units."""

import numpy as np

from lidargrit.core.errors import ScanError
from lidargrit.scans.projection.pixel_coordinates import row_elevation_rad
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import Scan

_FAR_M = 500.0  # in the median: no turning sensor sees half of its points so far away
_POINTS_MEASURED, _POINTS_AT_LEAST = 4096, 500
_ROWS_AT_LEAST = 8  # fewer do not show a height
_HEIGHTS_M = np.round(np.arange(-3.0, 3.01, 0.02), 2)  # of sensors on cars and robots, up and down
_ON_ROW = 0.1  # of the spacing of rows; by chance a fifth of the points are as near
_FEW_ON_ROWS, _MOST_ON_ROWS = 0.6, 0.85


def far_away(scan: Scan) -> ScanError | None:
    """Return the message about points farther than any sensor sees: coordinates of a map, or in another unit."""
    points_m = scan.points_xyz_m[:: max(1, len(scan) // _POINTS_MEASURED)].double().numpy()
    far_m = float(np.median(np.linalg.norm(points_m, axis=1)))
    if far_m < _FAR_M:
        return None
    level_m = points_m[:, :2]
    centre_m = float(np.linalg.norm(np.median(level_m, axis=0)))
    spread_m = float(np.median(np.linalg.norm(level_m - np.median(level_m, axis=0), axis=1)))
    if centre_m > spread_m:
        what = f"coordinates of a map in {scan.source} ({far_m / 1000:,.0f} km from the origin)"
        return ScanError(what, "those of a sensor, seen from its place", "subtract the sensor's place from x, y and z")
    what = f"points at {far_m:,.0f} m in the median in {scan.source}"
    return ScanError(what, "metres", "check the unit: divide millimetres by 1,000, centimetres by 100")


def told_height(scan: Scan, sensor: SensorModel) -> str:
    """Return what a person reads of points that a sensor saw from elsewhere on its axis; "" of others.

    From its own place a sensor's points lie on the elevations of its rows. Where few do, and nearly all after a shift
    of z, the points are in the frame of a car or of the ground.
    """
    points_m = scan.points_xyz_m[:: max(1, len(scan) // _POINTS_MEASURED)].double().numpy()
    rows_deg = np.sort(np.degrees(row_elevation_rad(sensor)))
    if len(points_m) < _POINTS_AT_LEAST or len(rows_deg) < _ROWS_AT_LEAST or np.ptp(rows_deg) < 1:
        return ""
    level_m = np.hypot(points_m[:, 0], points_m[:, 1])

    def share_on_rows(height_m: float) -> tuple[float, float]:
        """Return the share of points on rows, and by how little points are off in the mean."""
        elevation_deg = np.degrees(np.arctan2(points_m[:, 2] - height_m, level_m))
        above = np.searchsorted(rows_deg, elevation_deg).clip(1, len(rows_deg) - 1)
        off_deg = np.minimum(np.abs(elevation_deg - rows_deg[above - 1]), np.abs(elevation_deg - rows_deg[above]))
        off = off_deg / (rows_deg[above] - rows_deg[above - 1])
        return float((off < _ON_ROW).mean()), -float(off.mean())

    if share_on_rows(0.0)[0] > _FEW_ON_ROWS:
        return ""
    shares = {float(height_m): share_on_rows(float(height_m)) for height_m in _HEIGHTS_M}
    height_m = max(shares, key=shares.__getitem__)
    share, _ = shares[height_m]
    if share < _MOST_ON_ROWS:
        return ""
    where, cure = ("below", "subtract {:.2f} m from z") if height_m > 0 else ("above", "add {:.2f} m to z")
    what = f"points of {scan.source} are seen from {abs(height_m):.2f} m {where} the sensor ({sensor.name})"
    return f"{what}, of which {share:.0%} would lie on its rows; {cure.format(abs(height_m))}"
