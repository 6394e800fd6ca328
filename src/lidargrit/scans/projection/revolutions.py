"""How many revolutions of its sensor a scan holds, by the order of its points."""

import math

import numpy as np

from lidargrit.scans.types import Scan

_POINTS_OF_A_RING = 24  # fewer show no turning
_RINGS_AT_LEAST = 4
_STEADY = 0.95  # share of steps in one direction, of points in the order in which they were fired
_MORE_THAN_ONE = 1.02  # a revolution's end and beginning overlap by a few columns


def revolutions(scan: Scan) -> float | None:
    """Return the number of revolutions, the median over the rings; None where rings or their order are not known."""
    scan = scan.measured()  # points that a model added follow in an order of their own
    if scan.ring is None:
        return None
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


def told_revolutions(scan: Scan) -> str:
    """Return what a person reads of a scan of more than one revolution; "" of others."""
    turns = revolutions(scan)
    if turns is None or turns <= _MORE_THAN_ONE:
        return ""
    hidden = f"{1 - 1 / turns:.0%} of the points lie where another turn has some, and are hidden where those are nearer"
    return f"{turns:.2f} revolutions in {scan.source}: {hidden}; give one revolution a scan"
