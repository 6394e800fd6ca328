"""How many revolutions of its sensor a scan holds, by the order of its points, and whether beams have two returns."""

import math

import numpy as np
from jaxtyping import Float64

from lidargrit.scans.types import Scan

_POINTS_OF_A_RING = 24  # fewer show no turning
_RINGS_AT_LEAST = 4
_STEADY = 0.95  # share of steps in one direction, of points in the order in which they were fired
_FAR_STEP_RAD, _FAR_STEPS = 0.3, 0.01  # between points in the order in which they were fired, all lasers by turns
_BY_TURNS = 0.02  # of the spread of elevations, from point to point; files stored ring by ring have 0.001
_SAME_DIRECTION_RAD = 1e-5  # of two returns; those of neighbouring columns differ by a thousandth at least
_TWICE = 0.2  # share of points in the direction of another; up to 0.09 in files of one return
_MORE_THAN_ONE = 1.02  # a revolution's end and beginning overlap by a few columns


def revolutions(scan: Scan) -> float | None:
    """Return the number of revolutions, the median over the rings if they are known; None where no order tells it."""
    scan = scan.measured()  # points that a model added follow in an order of their own
    if scan.ring is None:
        return _turns_as_fired(scan)
    x, y = scan.points_xyz_m[:, :2].double().numpy().T
    azimuth_rad, ring = np.arctan2(y, x), scan.ring.numpy()
    order = ring.argsort(kind="stable")
    ends = np.flatnonzero(np.diff(ring[order])) + 1
    found = []
    for of_ring in np.split(azimuth_rad[order], ends):
        if len(of_ring) < _POINTS_OF_A_RING:
            continue
        steps_rad = (np.diff(of_ring) + math.pi) % (2 * math.pi) - math.pi
        if abs(np.sign(steps_rad).mean()) < 2 * _STEADY - 1:  # 0.95 one way and 0.05 the other
            return None
        found.append(abs(float(steps_rad.sum())) / (2 * math.pi))
    return float(np.median(found)) if len(found) >= _RINGS_AT_LEAST else None


def _turns_as_fired(scan: Scan) -> float | None:
    """Return the turns of points without rings, if they are stored as all lasers fire by turns."""
    if len(scan) < _POINTS_OF_A_RING * _RINGS_AT_LEAST:
        return None
    azimuth_rad, elevation_rad = _directions_rad(scan)
    steps_rad = (np.diff(azimuth_rad) + math.pi) % (2 * math.pi) - math.pi
    if (np.abs(steps_rad) > _FAR_STEP_RAD).mean() > _FAR_STEPS:
        return None
    by_turns = np.median(np.abs(np.diff(elevation_rad))) > _BY_TURNS * elevation_rad.std()
    return abs(float(steps_rad.sum())) / (2 * math.pi) if by_turns else None


def told_revolutions(scan: Scan) -> str:
    """Return what a person reads of a scan of more than one revolution, or of two returns of a beam; "" of others."""
    turns = revolutions(scan)
    if turns is None or turns <= _MORE_THAN_ONE:
        return _told_returns(scan)
    hidden = f"{1 - 1 / turns:.0%} of the points lie where another turn has some, and are hidden where those are nearer"
    return f"{turns:.2f} revolutions in {scan.source}: {hidden}; give one revolution a scan"


def _told_returns(scan: Scan) -> str:
    steps = [np.round(angle / _SAME_DIRECTION_RAD).astype(np.int64) for angle in _directions_rad(scan.measured())]
    direction = np.sort(steps[0] * (1 << 32) + steps[1])  # ten times as quick as to hash them, as np.unique does
    twice = np.count_nonzero(np.diff(direction) == 0) / max(1, len(direction))
    if twice < _TWICE:
        return ""
    what = f"{twice:.0%} of the points of {scan.source} lie behind or before another of the same beam"
    return f"{what}: two returns of each, of which the farther is hidden; give one return a beam"


def _directions_rad(scan: Scan) -> tuple[Float64[np.ndarray, "n"], Float64[np.ndarray, "n"]]:
    x, y, z = scan.points_xyz_m.double().numpy().T
    return np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
