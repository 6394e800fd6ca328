"""Spherical projection: points → the row of their elevation."""

import math

import numpy as np
from jaxtyping import Float32, Float64, Int16

_REFERENCE_TOP_DEG, _REFERENCE_BOTTOM_DEG = 3.0, -25.0  # the field of view that LidarGRIT fixes for KITTI-360
_SINE_BINS = 32768  # over [-1, 1]: each is 128 times as wide as the error of a sine, and edges cross few of them
_UNSURE = -2  # instead of a row: an edge passes through this bin, or through its neighbour
_LONE_ROW_RAD = math.radians(1)  # height of the row of a sensor with only one row


def rows(
    xyz_m: Float32[np.ndarray, "3 n"], range_m: Float32[np.ndarray, "n"], elevation_rad: Float64[np.ndarray, "H"]
) -> Int16[np.ndarray, "n"]:
    """Return the row whose elevation lies nearest to each point; -1 for points above all rows, H for those below.

    The span of a row ends midway to its neighbours; the first and the last row reach as far outwards as inwards. For
    equal rows these are the bins of Milioto et al., RangeNet++, IROS 2019, eq. 1.

    The result is that of a comparison with the edges in double precision, but few points need one. For most, a table
    gives the row of the sine of their elevation, z / range, in single precision. That sine has at most 3.5 rounding
    errors of 2^-24 (three of squares and sums, halved by the root; root; quotient), and adding 1 makes one more:
    together 1/128 of a bin. So only points in a bin that an edge crosses, or in the bin beside it, are compared.
    """
    edges = row_edges_rad(elevation_rad)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # Ranges that underflow or overflow give wrong values here; these points are compared below, too.
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
    """Return the elevations of the edges between rows, from the top down."""
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
    with np.errstate(divide="ignore", invalid="ignore"):  # of a range that is 0 in single precision
        elevation = np.nan_to_num(np.arcsin(xyz_m[2] / range_m))
    share = 1.0 - (elevation + abs(bottom)) / (abs(top) + abs(bottom))
    return np.clip(np.round(height * share), 0, height - 1).astype(np.int16)


def _row_of_sine(edges_rad: Float64[np.ndarray, "edges"]) -> Int16[np.ndarray, "bins"]:
    """Return the row of every bin of sines from -1 to 1, _UNSURE where an edge is near."""
    sine = np.sin(np.clip(edges_rad[::-1], -np.pi / 2, np.pi / 2))  # rising; a row may reach beyond the zenith
    edge_bin = np.minimum((sine + 1) * (_SINE_BINS / 2), _SINE_BINS - 1).astype(np.int64)
    from_below = np.arange(len(edges_rad) - 1, -2, -1, dtype=np.int16)
    table = np.repeat(from_below, np.diff(edge_bin, prepend=0, append=_SINE_BINS))
    table[np.clip(edge_bin + np.array([[-1], [0], [1]]), 0, _SINE_BINS - 1)] = _UNSURE
    return table
