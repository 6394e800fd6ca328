"""Spherical projection: points → the row of their elevation and the column of their azimuth."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float32, Float64, Int64

_REFERENCE_TOP_DEG, _REFERENCE_BOTTOM_DEG = 3.0, -25.0  # the field of view that LidarGRIT fixes for KITTI-360


def rows(xyz_m: Float32[np.ndarray, "n 3"], elevation_rad: Float64[np.ndarray, "H"]) -> Int64[np.ndarray, "n"]:
    """Return the row whose elevation lies nearest to each point, -1 for points above or below the sensor's span.

    The span of a row ends midway to its neighbours; the first and the last reach as far out as in. For equal rows these
    are the bins of Milioto et al., RangeNet++, IROS 2019, eq. 1.
    """
    edges = row_edges_rad(elevation_rad)
    wide = xyz_m.astype(np.float64)
    elevation = np.arctan2(wide[:, 2], np.hypot(wide[:, 0], wide[:, 1]))
    row = np.searchsorted(-edges, -elevation, side="right") - 1  # edges fall, searchsorted wants them to rise
    return np.where(row < len(elevation_rad), row, -1)


def row_edges_rad(elevation_rad: Float64[np.ndarray, "H"]) -> Float64[np.ndarray, "H+1"]:
    """Return the elevations between which each row lies, falling."""
    middles = (elevation_rad[1:] + elevation_rad[:-1]) / 2
    top = 2 * elevation_rad[0] - middles[0]
    bottom = 2 * elevation_rad[-1] - middles[-1]
    return np.concatenate(([top], middles, [bottom]))


def reference_rows(xyz_m: Float32[np.ndarray, "n 3"], height: int) -> Int64[np.ndarray, "n"]:
    """Return each point's row as LidarGRIT does: rounded in single precision, then clipped, nothing left out.

    Row 0 is half a bin wide and takes all above, the last row one and a half and takes all below.
    """
    # Python floats, so that the arithmetic below stays in single precision as in the program.
    top, bottom = math.radians(_REFERENCE_TOP_DEG), math.radians(_REFERENCE_BOTTOM_DEG)
    elevation = np.arcsin(xyz_m[:, 2] / np.linalg.norm(xyz_m, axis=1))
    share = 1.0 - (elevation + abs(bottom)) / (abs(top) + abs(bottom))
    return np.clip(np.round(height * share), 0, height - 1).astype(np.int64)
