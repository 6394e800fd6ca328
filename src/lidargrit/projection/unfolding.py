"""Scan unfolding: points in firing order → the row of their ring and the column of their azimuth."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64, Int, Int64

_STRAY_SHARE = 0.01  # a "ring" with fewer points than this share of a common one is a stray point at the seam


def rings_from_firing_order(xyz_m: Float32[np.ndarray, "n 3"]) -> Int64[np.ndarray, "n"]:
    """Number the rings of points that are stored ring by ring, each counter-clockwise from straight ahead.

    A ring begins where the azimuth, counted from 0 to 2 pi, falls by more than pi. A stray point beyond the seam, which
    would count as a ring of its own and shift every row, joins its neighbour.

    Returns:
        ring of every point, 0 = the first (on KITTI the highest).
    """
    azimuth_rad = azimuths_rad(xyz_m) % (2 * np.pi)
    starts = np.flatnonzero(np.diff(azimuth_rad) < -np.pi) + 1
    lengths = np.diff(np.concatenate(([0], starts, [len(xyz_m)])))
    true_ring = lengths >= max(1.0, _STRAY_SHARE * float(np.median(lengths)))
    number = np.maximum(np.cumsum(true_ring) - 1, 0)
    return np.repeat(number, lengths)


def reference_rings(xyz_m: Float32[np.ndarray, "n 3"], height: int) -> Int64[np.ndarray, "n"]:
    """Number the rings as the reference programs do: by quadrants, and rows counted from the bottom.

    Points before the first ring start keep row 0; with more than ``height`` rings the next one wraps to the last row
    and all earlier points stay in row 0.

    Source:
        Behaviour of hamedhaghighi/LidarGRIT@a3f86e7 and kazuto1011/r2dm@ad66e71, stated in the field's notes.
    """
    x_negative, y_negative = xyz_m[:, 0] < 0, xyz_m[:, 1] < 0
    quadrant = np.where(y_negative, np.where(x_negative, 2, 3), np.where(x_negative, 1, 0))
    starts = np.flatnonzero(np.roll(quadrant, 1) - quadrant == 3)
    row = np.zeros(len(xyz_m), dtype=np.int64)
    end = len(xyz_m)
    for place, start in enumerate(starts[::-1]):
        row[start:end] = (height - 1 - place) % height
        end = start
        if place == height:
            break
    return row


def azimuths_rad(xyz_m: Float32[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n"]:
    """Return the azimuth of points in (-pi, pi], counter-clockwise from +x, in double precision."""
    return np.arctan2(xyz_m[:, 1].astype(np.float64), xyz_m[:, 0].astype(np.float64))


def columns(xyz_m: Float32[np.ndarray, "n 3"], width: int) -> Int64[np.ndarray, "n"]:
    """Return the column whose span [pi - 2 pi w/W, pi - 2 pi (w+1)/W) holds each point's azimuth, around the circle."""
    return np.floor((np.pi - azimuths_rad(xyz_m)) * (width / (2 * np.pi))).astype(np.int64) % width


def reference_columns(xyz_m: Float32[np.ndarray, "n 3"], width: int) -> Int[np.ndarray, "n"]:
    """Return each point's column as LidarGRIT does: rounded in single precision, then clipped.

    The first column is half as wide as the others, the last half as wide again.
    """
    azimuth_rad = -np.arctan2(xyz_m[:, 1], xyz_m[:, 0])
    return np.clip(np.round(width * ((azimuth_rad / np.pi + 1) / 2)), 0, width - 1).astype(np.int64)
