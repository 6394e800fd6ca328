"""The laser of each point: scans → ring numbers, by a field of the files or by the order of their points."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64

from lidargrit.scans.fit_sensor.points import Points

Method = Literal["ring field", "ring by ring", "column by column", "elevation clusters"]

_FORWARD_AT_LEAST = 0.9  # of all steps in azimuth, in files sorted ring by ring; noise and ring changes take the rest
_TURNS_AT_LEAST = 2.5  # a file sorted by columns goes round once
_FALL_DEG = 12.0  # a new ring; motion-corrected scans of KITTI step back by up to 7 degrees within one
_SEAMS_DEG = (0.0, 180.0, 90.0, -90.0)  # where sweeps are cut; at any other place there is a ring too many
_STRAY_SHARE = 0.01  # a ring of fewer points than this share of a common one is a stray at the seam
_SAME_COUNT_AT_LEAST = 0.8  # of the scans; the others lost a ring, or gained one
_LASERS_AT_MOST = 256
_RINGS_AT_MOST = 1024  # of a field; one of more values counts something else, such as points
_SAME_ELEVATION = 0.1  # of the change in elevation to a point anywhere in the file


@dataclass(frozen=True, eq=False)
class Rings:
    """The laser of every point of every scan.

    Args:
        method: way in which the laser of every point was found.
        of_point: ring number of every point, one array for each scan; -1 where it is not known. Numbers are the file's
            own, or count in its order.
        used: scans whose rings could be found.
        counter_clockwise: whether the sensor turns counter-clockwise, seen from above; None if the order of points does
            not show it.
        start_deg: azimuth where a file begins its rings or its first column; None if unknown.
        lasers: number of entries of a firing, where files keep one for every laser, one firing after another; else 0.
    """

    method: Method
    of_point: tuple[Int64[np.ndarray, "_"], ...]
    used: tuple[int, ...]
    counter_clockwise: bool | None = None
    start_deg: float | None = None
    lasers: int = 0


def recover_rings(scans: Sequence[Points]) -> Rings | None:
    """Find the laser of every point from what files hold or how they are sorted; None if neither tells.

    Files of KITTI are sorted ring by ring; most drivers write column by column, all lasers of one firing after another
    (then places without a return must have been kept, for else lasers cannot be counted).
    """
    field = tuple(points.ring for points in scans if points.ring is not None)
    if len(field) == len(scans) and all(len(np.unique(rings)) <= _RINGS_AT_MOST for rings in field):
        columns = _column_by_column(scans)
        turning, start = _turning(scans, field)
        return Rings("ring field", field, tuple(range(len(scans))), turning, start, columns.lasers if columns else 0)
    return _ring_by_ring(scans) or _column_by_column(scans)


def _ring_by_ring(scans: Sequence[Points]) -> Rings | None:
    forward, turns = zip(*(_forward_and_turns(points) for points in scans), strict=True)
    if abs(float(np.median(forward))) < _FORWARD_AT_LEAST or float(np.median(turns)) < _TURNS_AT_LEAST:
        return None
    sign = 1 if np.median(forward) > 0 else -1
    seam = min(_SEAMS_DEG, key=lambda seam_deg: sum(_count(_segments(points, sign, seam_deg)) for points in scans))
    numbers = [_segments(points, sign, seam) for points in scans]
    counts = Counter(map(_count, numbers))
    common, times = counts.most_common(1)[0]
    if times < _SAME_COUNT_AT_LEAST * len(scans) or common > _LASERS_AT_MOST:
        return None
    used = tuple(index for index, number in enumerate(numbers) if _count(number) == common)
    return Rings("ring by ring", tuple(numbers[index] for index in used), used, sign > 0, seam)


def _forward_and_turns(points: Points) -> tuple[float, float]:
    """Return the excess of steps counter-clockwise over steps clockwise, and the turns of all steps together."""
    step = _wrapped(np.diff(points.azimuth_deg))
    return float(np.sign(step).mean()), abs(float(step.sum())) / 360


def _segments(points: Points, sign: int, seam_deg: float) -> Int64[np.ndarray, "n"]:
    """Number the stretches of points in which azimuth, counted from the seam, does not fall back."""
    along_deg = (sign * (points.azimuth_deg - seam_deg)) % 360
    starts = np.flatnonzero(np.diff(along_deg) < -_FALL_DEG) + 1
    lengths = np.diff(np.concatenate(([0], starts, [len(points)])))
    true_ring = lengths >= max(1.0, _STRAY_SHARE * float(np.median(lengths)))
    return np.repeat(np.maximum(np.cumsum(true_ring) - 1, 0), lengths)


def _count(number: Int64[np.ndarray, "n"]) -> int:
    return int(number.max()) + 1


def _column_by_column(scans: Sequence[Points]) -> Rings | None:
    """Find the number of lasers as the distance in the file at which the same elevation comes again."""
    first = scans[0]
    elevation = np.full(first.num_in_file, np.nan)
    elevation[first.index] = first.elevation_deg
    lags = range(2, min(_LASERS_AT_MOST, first.num_in_file // 8) + 1)
    change = np.array([_median_of_known(np.abs(elevation[lag:] - elevation[:-lag])) for lag in lags])
    same = change < _SAME_ELEVATION * float(np.median(change))  # multiples of the number of lasers come again as well
    lasers = next((lag for lag, again in zip(lags, same, strict=True) if again), None)
    if lasers is None or any(points.num_in_file % lasers for points in scans):
        return None
    numbers = tuple(points.index % lasers for points in scans)
    turning, start = _turning(scans, numbers)
    return Rings("column by column", numbers, tuple(range(len(scans))), turning, start, lasers)


def _median_of_known(values: Float64[np.ndarray, "n"]) -> float:
    """Return the median of values without NaN, as is where a beam did not return; NaN where all are."""
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else math.nan


def _turning(scans: Sequence[Points], numbers: Sequence[Int64[np.ndarray, "_"]]) -> tuple[bool | None, float | None]:
    """Return in which direction the points of each laser turn in the file, and where they begin."""
    signs, starts = [], []
    for points, number in zip(scans, numbers, strict=True):
        for ring in np.unique(number)[::4]:
            azimuth = points.azimuth_deg[number == ring]
            if len(azimuth) > 50:
                signs.append(float(np.sign(_wrapped(np.diff(azimuth))).mean()))
                starts.append(azimuth[0])
    if not signs or abs(float(np.median(signs))) < 0.5:
        return None, None
    middle = np.exp(1j * np.radians(starts)).mean()
    return bool(np.median(signs) > 0), float(np.degrees(np.angle(middle)))


def _wrapped(degrees: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
    return (degrees + 180) % 360 - 180
