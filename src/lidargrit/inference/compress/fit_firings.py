"""Points in the order of a spinning sensor's file → the table of its lasers and firings, and each point's pixel.

Files of KITTI list one laser after the other, each by its azimuth. Drivers of Velodyne's HDL-64E place a point on the
laser's ray: at an elevation, a height and a distance beside the axis that never change, and at an angle that an encoder
counts in 4,000ths of a revolution. So points lie on a grid to a millimetre; their distance alone is free. Points of
KITTI odometry were moved by the car's way during the revolution, which is found: undone, it shows the grid.
"""

from copy import copy
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex128, Float64, Int64

from lidargrit.inference.compress.firings import (
    LENGTH_M,
    MOTION,
    PHASE,
    PIXELS_AT_MOST,
    SLOPE,
    Firings,
    Points,
    cross,
)

_UNITS = 4000  # of an HDL-64E's encoder
_UNIT = 2 * np.pi / _UNITS
_LASERS = range(8, 257)
_POINTS_A_LASER = 100
_ONE_IN = 4  # points is enough to find all that they have in common
_ON_A_CONE_M = 0.002  # points off their laser's cone by less were not moved
_OFF_AT_MOST_M = 0.02  # points off their rays: median beyond which this is no such file
_BEFORE = 1024  # by which a row's first point may lie behind another that is as far around: a quarter of a unit
_NEAREST_M = 0.1  # to the axis; nearer points tell no angle, and one alone would turn its laser's lines
_TINY_M = 2e-4  # rounding to a millimetre moves points by this in the median
_TURNS = np.arange(-0.1, 0.1, 0.0005)  # of the car in a revolution, in radians
_ASIDE_M = np.arange(-0.06, 0.0601, 0.002)


class Fitted(NamedTuple):
    """A table of firings, and the pixel of every point.

    Args:
        row: laser of each point (n).
        column: firing of each point (n), as columns of the image.
    """

    firings: Firings
    row: Int64[np.ndarray, " n"]
    column: Int64[np.ndarray, " n"]


def fit_firings(points_m: Points) -> Fitted | None:
    """Return the firings that points (n, 3) in metres are of; None if they are of no such file."""
    row = _lasers(points_m)
    if row is None:
        return None
    chosen = _some_of_each(row, np.hypot(*points_m[:, :2].T) > _NEAREST_M)
    some = _Fit(points_m[chosen], row[chosen])
    some.find_cones()
    some.find_angles()
    return some.of_all(points_m, row).result()


def _lasers(points_m: Points) -> Int64[np.ndarray, " n"] | None:
    """Return the laser of each point, counted from the first: the next begins where azimuths begin again."""
    azimuth = np.arctan2(points_m[:, 1], points_m[:, 0]) % (2 * np.pi)
    ahead = np.diff(azimuth)
    row = np.concatenate([[0], np.cumsum((ahead < -np.pi).astype(np.int64) - (ahead > np.pi))])
    row -= row.min()
    if row[-1] + 1 not in _LASERS or len(row) < _POINTS_A_LASER * (row.max() + 1):
        return None
    return row


def _some_of_each(row: Int64[np.ndarray, " n"], tell: Bool[np.ndarray, " n"]) -> Int64[np.ndarray, " m"]:
    """Return the numbers of a share of the points that tell an angle, and at least one of every laser."""
    chosen = np.arange(0, len(row), _ONE_IN)
    chosen = chosen[tell[chosen]]
    lasers, first = np.unique(row, return_index=True)
    return np.sort(np.append(chosen, first[~np.isin(lasers, row[chosen])]))


class _Fit:
    """Finds what the points have in common, one after the other."""

    def __init__(self, points_m: Points, row: Int64[np.ndarray, " n"]) -> None:
        self._points_m, self._row, self._lasers = points_m, row, int(row.max()) + 1
        self._motion, self._weight = np.zeros(6), np.ones(len(row))
        self._slope = self._height = self._aside = self._phase = np.zeros(self._lasers)
        self._see()

    def _see(self) -> None:
        """Undo the motion, as the file has it: by the azimuth at which a point was seen, from behind to behind."""
        x, y, _ = self._points_m.T
        seen = share = np.arctan2(y, x) / (2 * np.pi)
        for _ in range(4 if self._motion.any() else 1):
            self._at_rest_m = _moved(self._points_m, share, self._motion)
            x, y, _ = self._at_rest_m.T
            share = np.arctan2(y, x) / (2 * np.pi)
            share = np.clip(share - seen, -0.5, 0.5) * (np.abs(share - seen) <= 0.5) + seen
        self._share, self._azimuth, self._flat_m = share, np.arctan2(y, x), np.maximum(np.hypot(x, y), _NEAREST_M)

    def find_cones(self) -> None:
        """Find the elevation and height of each laser, and of the motion what moves points off their cones."""
        for _ in range(8):
            x, y, z = self._at_rest_m.T
            off_m, slope, height = self._off_lines(z)
            self._slope, self._height = slope, height
            if not self._motion.any() and np.quantile(np.abs(off_m), 0.9) < _ON_A_CONE_M:
                return
            self._weight = _weights(off_m)
            share, lean = self._share, slope[self._row]
            cosine, sine = x / self._flat_m, y / self._flat_m
            effects = [-lean * cosine, -lean * sine, 1.0, y + lean * z * sine, -x - lean * z * cosine]
            self._move([0, 1, 2, 3, 4], off_m, [share * effect for effect in effects])

    def find_angles(self) -> None:
        """Find where each laser's rays pass the axis and its angles beside whole units, and the rest of the motion."""
        if self._motion.any():
            self._find_turn()
        concentration, far_m = np.zeros((self._lasers, len(_ASIDE_M)), complex), np.zeros(self._lasers)
        for laser in range(self._lasers):
            of = self._some(laser, 400)
            concentration[laser], far_m[laser] = self._waves(of, _ASIDE_M).mean(1), np.median(self._flat_m[of])
        # Near by, distances beside the axis are like angles: there they are taken to be those of the far lasers.
        farthest = np.argsort(-far_m)[: max(1, self._lasers // 4)]
        usual_m = np.median(np.abs(_ASIDE_M[np.abs(concentration[farthest]).argmax(1)]))
        best = (np.abs(concentration) - 8 * np.abs(np.abs(_ASIDE_M) - usual_m)).argmax(1)
        self._aside = _ASIDE_M[best]
        self._phase = np.angle(concentration[np.arange(self._lasers), best]) / (2 * np.pi)
        for _ in range(8):
            off_m = self._off_angles()
            self._weight = _weights(off_m)
            if self._motion.any():
                cosine, sine = np.cos(self._azimuth), np.sin(self._azimuth)
                self._move([0, 1, 5], off_m, [self._share * effect for effect in (-sine, cosine, self._flat_m)])
                off_m = self._off_angles()
            _, beside, aside = self._off_lines(off_m)
            self._phase, self._aside = self._phase + beside / _UNIT, self._aside - aside
        self._weight = np.ones(len(self._row))
        self._slope, self._height = self._off_lines(self._at_rest_m[:, 2])[1:]

    def of_all(self, points_m: Points, row: Int64[np.ndarray, " n"]) -> "_Fit":
        """Return the same of more points."""
        fit = copy(self)
        fit._points_m, fit._row, fit._weight = points_m, row, np.ones(len(row))
        fit._see()
        return fit

    def result(self) -> Fitted | None:
        """Return what was found as whole numbers; None if points do not lie on such rays."""
        off_m = np.maximum(np.abs(self._off_angles()), np.abs(self._off_lines(self._at_rest_m[:, 2])[0]))
        if np.median(off_m) > _OFF_AT_MOST_M:
            return None
        angle = np.rint(self._angles() - self._phase[self._row]).astype(np.int64) % _UNITS
        shift = _shifts(self._row, angle, self._lasers)
        fired, firing = np.unique((angle + shift[self._row]) % _UNITS, return_inverse=True)
        if self._lasers * len(fired) > PIXELS_AT_MOST:
            return None
        begins = np.unique(self._row, return_index=True)[1]
        slope, height = _whole(self._slope / SLOPE), _whole(self._height / LENGTH_M)
        aside, phase = _whole(self._aside / LENGTH_M), _whole(self._phase / PHASE)
        motion = _whole(self._motion / MOTION)
        first = np.floor(self._azimuth[begins] / _UNIT / PHASE).astype(np.int64) - _BEFORE
        firings = Firings(_UNITS, fired, slope, height, aside, phase, shift, first, motion)
        return Fitted(firings, self._row, (firing - firings.beside()[self._row]) % len(fired))

    def _find_turn(self) -> None:
        """Find how far the car turned, by lasers that look far: at the right angle their points are in step."""
        far_m = [np.median(self._flat_m[self._some(laser, 100)]) for laser in range(self._lasers)]
        chosen = [self._some(laser, 250) for laser in np.argsort(far_m)[-10:]]
        total = np.zeros(len(_TURNS))
        for of in chosen:
            waves, each = self._waves(of, _ASIDE_M[::5]), np.exp(2j * np.pi * self._share[of] * _TURNS[0] / _UNIT)
            step = np.exp(2j * np.pi * self._share[of] * (_TURNS[1] - _TURNS[0]) / _UNIT)
            for number in range(len(_TURNS)):
                total[number] += np.abs(waves @ each).max()
                each = each * step
        self._motion[5] += _TURNS[total.argmax()]
        self._see()

    def _some(self, laser: int, count: int) -> Int64[np.ndarray, " m"]:
        of = np.flatnonzero(self._row == laser)
        return of[:: max(1, len(of) // count)]

    def _waves(self, of: Int64[np.ndarray, " m"], aside_m: np.ndarray) -> Complex128[np.ndarray, "A m"]:
        """Return points on a circle by their angle beside whole units, for each distance beside the axis."""
        turns = self._azimuth[of] + aside_m[:, None] / self._flat_m[of]
        return np.exp(2j * np.pi * turns / _UNIT)

    def _angles(self) -> Float64[np.ndarray, " n"]:
        beside = np.arcsin(np.clip(self._aside[self._row] / self._flat_m, -1, 1))
        return (self._azimuth + beside) / _UNIT

    def _off_angles(self) -> Float64[np.ndarray, " n"]:
        off = self._angles() - self._phase[self._row]
        return (off - np.rint(off)) * _UNIT * self._flat_m

    def _off_lines(self, values: Float64[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return values less each laser's line over the distance, and the lines' slopes and heights."""
        row, at, weight = self._row, self._flat_m, self._weight

        def sums(of: np.ndarray) -> np.ndarray:
            return np.bincount(row, weight * of, self._lasers)

        count, first, second = sums(np.ones_like(at)) + 1e-9, sums(at), sums(at * at) + 1e-6
        value, product = sums(values), sums(at * values)
        slope = (count * product - first * value) / np.maximum(count * second - first * first, 1e-9)
        height = (value - slope * first) / count
        return values - slope[row] * at - height[row], slope, height

    def _move(self, which: list[int], off_m: np.ndarray, effects: list[np.ndarray]) -> None:
        """Change some numbers of the motion so that points come nearer to the lines of their lasers."""
        beside = np.stack([self._off_lines(effect)[0] for effect in effects], 1)
        weighted = beside * self._weight[:, None]
        change = np.linalg.solve(
            weighted.T @ beside + 1e-6 * np.eye(len(which)), weighted.T @ self._off_lines(off_m)[0]
        )
        self._motion[which] = np.clip(self._motion[which] - change, -10, 10)
        self._see()


def _whole(numbers: np.ndarray) -> np.ndarray:
    """Return the nearest whole numbers of 32 bits."""
    return np.clip(np.rint(numbers), -(2**31), 2**31 - 1).astype(np.int64)


def _weights(off_m: np.ndarray) -> np.ndarray:
    """Return the weights of points by how far they are off: those far beyond the median hardly count."""
    usual_m = max(float(np.median(np.abs(off_m))), _TINY_M)
    return 1 / (1 + (off_m / (3 * usual_m)) ** 2) ** 2


def _moved(points_m: Points, share: Float64[np.ndarray, " n"], motion: Float64[np.ndarray, " 6"]) -> Points:
    """Return points as the sensor saw them; inverse to what :meth:`Firings.rays` does to third order."""
    if not motion.any():
        return points_m
    by, moved = share[:, None] * motion[3:], points_m
    for power in (3, 2, 1):
        moved = points_m + cross(by, moved) / power
    return moved + share[:, None] * motion[:3]


def _shifts(row: Int64[np.ndarray, " n"], angle: Int64[np.ndarray, " n"], lasers: int) -> Int64[np.ndarray, "K"]:
    """Return by how many units the angles of each laser are to be shifted for those of one firing to be one.

    An HDL-64E fires every 1.92 units, so two angles in succession are rare, and lie at the same firings in all rows.
    """
    hit = np.zeros((lasers, _UNITS))
    hit[row, angle] = 1
    succeed = np.fft.rfft(hit * np.roll(hit, 1, 1), axis=1)
    shift, together = np.zeros(lasers, dtype=np.int64), succeed[0]
    near = np.concatenate([np.arange(200), np.arange(-200, 0)])
    turns = 2j * np.pi * np.arange(succeed.shape[1]) / _UNITS
    for laser in range(1, lasers):
        alike = np.fft.irfft(together * np.conj(succeed[laser]), _UNITS)
        shift[laser] = near[alike[near].argmax()]
        together = together + succeed[laser] * np.exp(-turns * shift[laser])
    return shift
