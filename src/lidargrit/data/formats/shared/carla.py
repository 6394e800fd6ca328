"""Points as CARLA sends them, with y to the right → the same points with y to the left."""

from collections.abc import Collection
from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from lidargrit.scans.file_rows import FileRows
from lidargrit.scans.types import Scan

NOTE = "files of CARLA, left-handed (y to the right), are read with y to the left"
_SEMANTIC = "cosangle"  # a column of its semantic LiDAR alone
_POINTS_AT_LEAST = 100
_RANGES_APART_M = 1.0  # at one range every reflectance is a function of it
_OFF_AT_MOST_M, _OFF_IN_THE_MEDIAN_M = 1.0, 0.1  # by noise along the ray, which comes after the intensity
_SHARE = 0.99
_STEADY = 0.8  # mean sign of the steps in azimuth, of points in the order in which they were fired


def right_handed(scan: Scan, names: Collection[str] = ()) -> Scan:
    """Return a scan with y to the left, if CARLA made it and it was saved as it was sent.

    CARLA's intensity is exp(-rate x range), which no sensor's is, and its rays turn to the right: where y points to the
    right, azimuths rise from point to point. Points that were mirrored before they were saved stay.

    Args:
        names: names of the file's columns.

    Source:
        RayCastLidar.cpp and RayCastSemanticLidar.cpp of CARLA 0.9.
    """
    points_m = scan.points_xyz_m.double().numpy()
    is_carla = _SEMANTIC in {name.lower() for name in names} or _has_intensity_of_carla(scan, points_m)
    return mirrored(scan) if is_carla and _azimuths_rise(points_m) else scan


def mirrored(scan: Scan) -> Scan:
    """Return a scan with left and right exchanged, in the rows of its file, too, and a note on it."""
    points = scan.points_xyz_m * scan.points_xyz_m.new_tensor([1.0, -1.0, 1.0])
    rows = scan.rows
    if rows is not None:
        columns = {name: -values if name.lower() == "y" else values for name, values in rows.columns.items()}
        rows = FileRows(columns, rows.of_point)
    return replace(scan, points_xyz_m=points, rows=rows, notes=(*scan.notes, NOTE))


def _has_intensity_of_carla(scan: Scan, points_m: Float64[np.ndarray, "n 3"]) -> bool:
    """Return whether reflectance falls with range as CARLA's does, at any rate."""
    if scan.reflectance is None or len(scan) < _POINTS_AT_LEAST:
        return False
    intensity = scan.reflectance.double().numpy()
    if intensity.min() <= 0:
        return False
    range_m, lost = np.linalg.norm(points_m, axis=1), -np.log(intensity)
    rate = float(np.median(lost / range_m))
    if rate <= 0 or range_m.std() < _RANGES_APART_M:
        return False
    off_m = np.abs(lost / rate - range_m)
    return bool(np.median(off_m) < _OFF_IN_THE_MEDIAN_M and (off_m < _OFF_AT_MOST_M).mean() > _SHARE)


def _azimuths_rise(points_m: Float64[np.ndarray, "n 3"]) -> bool:
    steps_rad = (np.diff(np.arctan2(points_m[:, 1], points_m[:, 0])) + np.pi) % (2 * np.pi) - np.pi
    return len(steps_rad) > 0 and float(np.sign(steps_rad).mean()) > _STEADY
