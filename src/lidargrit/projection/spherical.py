"""Spherical projection: points → the row of their elevation."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float32, Float64, Int16

_REFERENCE_TOP_DEG, _REFERENCE_BOTTOM_DEG = 3.0, -25.0  # the field of view that LidarGRIT fixes for KITTI-360
_SINE_BINS = 32768  # over [-1, 1]: each 128 times as wide as a sine is wrong, and few of them crossed by an edge
_UNSURE = -2  # in place of a row: an edge passes through this bin, or through its neighbour
_LONE_ROW_RAD = math.radians(1)  # height of the only row of a sensor, which has no neighbour to end at


def rows(
    xyz_m: Float32[np.ndarray, "3 n"], range_m: Float32[np.ndarray, "n"], elevation_rad: Float64[np.ndarray, "H"]
) -> Int16[np.ndarray, "n"]:
    """Return the row whose elevation lies nearest to each point; -1 for points above all rows, H for those below.

    The span of a row ends midway to its neighbours; the first and the last reach as far out as in. For equal rows these
    are the bins of Milioto et al., RangeNet++, IROS 2019, eq. 1.

    A point counts as compared with the edges in double precision. Few need to be: a table gives the row of their sine,
    z / range, in single precision. Of 2^-24 each, the sine has at most 3.5 rounding errors (three of squares and sums,
    halved by the root; root; quotient) and the sum with 1 one more, together 1/128 of a bin. So only points in a bin
    that an edge crosses, or in one beside it, remain.
    """
    edges = row_edges_rad(elevation_rad)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # A range that underflows or overflows makes nonsense here; these points remain, too.
        sine = xyz_m[2] / range_m
        sine += 1
        sine *= _SINE_BINS / 2
        row = _row_of_sine(edges).take(sine.astype(np.int32), mode="clip")
    remain = np.flatnonzero((row == _UNSURE) | (range_m < 1e-15) | (range_m == np.inf))  # 1e-15 squared is not yet 0
    x, y, z = xyz_m[:, remain].astype(np.float64)
    # Edges fall, searchsorted wants them to rise.
    row[remain] = np.searchsorted(-edges, -np.arctan2(z, np.hypot(x, y)), side="right") - 1
    return row


def row_edges_rad(elevation_rad: Float64[np.ndarray, "H"]) -> Float64[np.ndarray, "H+1"]:
    """Return the elevations between which each row lies, falling."""
    if len(elevation_rad) == 1:
        return elevation_rad + np.array([_LONE_ROW_RAD / 2, -_LONE_ROW_RAD / 2])
    middles = (elevation_rad[1:] + elevation_rad[:-1]) / 2
    top = 2 * elevation_rad[0] - middles[0]
    bottom = 2 * elevation_rad[-1] - middles[-1]
    return np.concatenate(([top], middles, [bottom]))


def reference_rows(
    xyz_m: Float32[np.ndarray, "3 n"], range_m: Float32[np.ndarray, "n"], height: int
) -> Int16[np.ndarray, "n"]:
    """Return each point's row as LidarGRIT does: rounded in single precision, then clipped, nothing left out.

    Row 0 is half a bin wide and takes all above, the last row one and a half and takes all below.
    """
    # Python floats, so that the arithmetic below stays in single precision as in the program.
    top, bottom = math.radians(_REFERENCE_TOP_DEG), math.radians(_REFERENCE_BOTTOM_DEG)
    elevation = np.arcsin(xyz_m[2] / range_m)
    share = 1.0 - (elevation + abs(bottom)) / (abs(top) + abs(bottom))
    return np.clip(np.round(height * share), 0, height - 1).astype(np.int16)


def _row_of_sine(edges_rad: Float64[np.ndarray, "edges"]) -> Int16[np.ndarray, "bins"]:
    """Return the row of every bin of sines from -1 to 1, or that it is unsure."""
    sine = np.sin(np.clip(edges_rad[::-1], -np.pi / 2, np.pi / 2))  # rising; a row may reach beyond the zenith
    edge_bin = np.minimum((sine + 1) * (_SINE_BINS / 2), _SINE_BINS - 1).astype(np.int64)
    from_below = np.arange(len(edges_rad) - 1, -2, -1, dtype=np.int16)
    table = np.repeat(from_below, np.diff(edge_bin, prepend=0, append=_SINE_BINS))
    table[np.clip(edge_bin + np.array([[-1], [0], [1]]), 0, _SINE_BINS - 1)] = _UNSURE
    return table
