"""Scan unfolding: points in firing order → the row of their ring and the column of their azimuth."""

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int32

_STRAY_SHARE = 0.01  # a "ring" with fewer points than this share of a common one is a stray point at the seam


def rings_from_firing_order(xyz_m: Float32[np.ndarray, "3 n"]) -> Int32[np.ndarray, "n"]:
    """Number the rings of points that are stored ring by ring, each counter-clockwise from straight ahead.

    A ring begins where the azimuth, counted from 0 to 2 pi, falls by more than pi. A stray point beyond the seam, which
    would count as a ring of its own and shift every row, joins its neighbour. Rings that are all equally long and begin
    elsewhere, as CARLA's behind, are counted by their length.

    Returns:
        ring of every point, 0 = the first (on KITTI the highest).
    """
    # To fall by more than pi, the azimuth must go from the right half, above pi, to the left, below it.
    to_the_left = np.flatnonzero((xyz_m[1, :-1] < 0) & (xyz_m[1, 1:] >= 0))
    before, after = (azimuths_rad(xyz_m[:, at]) % (2 * np.pi) for at in (to_the_left, to_the_left + 1))
    starts = to_the_left[after - before < -np.pi] + 1
    lengths = np.diff(np.concatenate(([0], starts, [xyz_m.shape[1]])))
    true_ring = lengths >= max(1.0, _STRAY_SHARE * float(np.median(lengths)))
    number = np.maximum(np.cumsum(true_ring) - 1, 0).astype(np.int32)
    rings = int(number[-1])  # one fewer, where files begin their rings elsewhere: the seam cuts each into two
    if rings > 1 and xyz_m.shape[1] % rings == 0 and _turn_once(azimuths_rad(xyz_m).reshape(rings, -1)):
        return np.repeat(np.arange(rings, dtype=np.int32), xyz_m.shape[1] // rings)
    return np.repeat(number, lengths)


def _turn_once(azimuth_rad: Float64[np.ndarray, "H W"]) -> bool:
    """Return whether each of so many equally long rings turns counter-clockwise, once, and from the same place."""
    steps_rad = np.diff(azimuth_rad, axis=1) % (2 * np.pi)
    turns = steps_rad.sum(1)
    begins = np.abs(np.angle(np.exp(1j * (azimuth_rad[:, 0] - azimuth_rad[0, 0]))))
    return bool((steps_rad > 0).all() and (turns < 2 * np.pi).all() and begins.max() <= steps_rad.max())


def reference_rings(xyz_m: Float32[np.ndarray, "3 n"], height: int) -> Int32[np.ndarray, "n"]:
    """Number the rings as the reference programs do: by quadrants, and rows counted from the bottom.

    Points before the first ring start keep row 0; with more than ``height`` rings the next one wraps to the last row
    and all earlier points stay in row 0.

    Source:
        Behaviour of hamedhaghighi/LidarGRIT@a3f86e7 and kazuto1011/r2dm@ad66e71, stated in the field's notes.
    """
    x_negative, y_negative = xyz_m[0] < 0, xyz_m[1] < 0
    quadrant = np.where(y_negative, np.where(x_negative, 2, 3), np.where(x_negative, 1, 0))
    starts = np.flatnonzero(np.roll(quadrant, 1) - quadrant == 3)
    row = np.zeros(xyz_m.shape[1], dtype=np.int32)
    end = xyz_m.shape[1]
    for ring, start in enumerate(starts[::-1]):  # from the lowest ring up
        row[start:end] = (height - 1 - ring) % height
        end = start
        if ring == height:
            break
    return row


def azimuths_rad(xyz_m: Float32[np.ndarray, "3 n"]) -> Float64[np.ndarray, "n"]:
    """Return the azimuth of points in [-pi, pi], counter-clockwise from +x, in double precision."""
    return np.arctan2(xyz_m[1], xyz_m[0], dtype=np.float64)


def columns(xyz_m: Float32[np.ndarray, "3 n"], width: int, first_edge_rad: float = np.pi) -> Int32[np.ndarray, "n"]:
    """Return the column whose span [edge - 2 pi w/W, edge - 2 pi (w+1)/W) holds each point's azimuth, round the circle.

    The result is that of double precision, but only points near an edge are computed so. In single precision, azimuths
    of up to pi are wrong by at most 2^-20 (4 units in the last place, more than any arc function in use). The
    difference from pi and the product add less than that; together the error is below W 2^-21 columns. Only points
    within twice that distance of an edge are computed again.
    """
    x, y, _ = torch.from_numpy(xyz_m)  # torch, for its arctan2 is fast on every processor
    at = torch.atan2(y, x).numpy()
    np.subtract(first_edge_rad, at, out=at)
    at *= width / (2 * np.pi)
    if first_edge_rad != np.pi:  # else nothing lies outside
        at %= width
    column = at.astype(np.int32)  # floors what is never negative
    at -= column
    margin = width * 2**-20
    remain = np.flatnonzero((at < margin) | (at > 1 - margin))
    column[remain] = np.floor((first_edge_rad - azimuths_rad(xyz_m[:, remain])) * (width / (2 * np.pi))) % width
    return column


def reference_columns(xyz_m: Float32[np.ndarray, "3 n"], width: int) -> Int32[np.ndarray, "n"]:
    """Return each point's column as LidarGRIT does: rounded in single precision, then clipped.

    The first column is half as wide as the others, the last half as wide again.
    """
    azimuth_rad = -np.arctan2(xyz_m[1], xyz_m[0])
    return np.clip(np.round(width * ((azimuth_rad / np.pi + 1) / 2)), 0, width - 1).astype(np.int32)
