"""What the points of a file say of the sensor that made it, where only a folder's layout names the data set."""

from pathlib import Path

import numpy as np

from lidargrit.core.errors import ScanError
from lidargrit.data.formats import BadPoints, ScanFormat

_POINTS_AT_LEAST = 500  # fewer show no elevations
_HIGHEST_DEG, _ABOVE_AT_MOST = 8.0, 0.05  # an HDL-64E's beams end at +2; near the car some are seen from below
_LOWEST_DEG = -18.0  # of the 1 % quantile: KITTI's lies at -24 to -20, that of a VLP-16 at -15
_DROP: BadPoints = "drop"


def contradicts_hdl64e(path: Path, form: type[ScanFormat]) -> bool:
    """Return whether the points of a scan cannot be an HDL-64E's; False where too few tell.

    Args:
        form: format of that file.
    """
    try:
        points_m = form.read(path, 0, _DROP).points_xyz_m.numpy()
    except ScanError:  # told where it is read
        return False
    if len(points_m) < _POINTS_AT_LEAST:
        return False
    x, y, z = points_m.T
    elevation_deg = np.degrees(np.arctan2(z, np.hypot(x, y)))
    above = float((elevation_deg > _HIGHEST_DEG).mean())
    return above > _ABOVE_AT_MOST or float(np.quantile(elevation_deg, 0.01)) > _LOWEST_DEG
