"""Whether points are in the frame of the sensor that saw them: coordinates of maps, and of other units."""

from __future__ import annotations

import numpy as np

from lidargrit.errors import ScanError
from lidargrit.structures import Scan

_FAR_M = 500.0  # in the median: no turning sensor sees half of its points so far away
_POINTS_MEASURED = 4096


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
