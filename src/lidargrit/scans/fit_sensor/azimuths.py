"""Points and their rings → the step between firings, columns of a revolution, azimuth offset of each laser."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64

from lidargrit.scans.fit_sensor.points import Points

_FINEST_DEG, _COARSEST_DEG = 0.03, 4.0  # 12,000 to 90 columns; sensors have 360 to 4096
_FAR_M = 5.0  # nearer points are blurred by parallax, and by the rounding of their coordinates
_STEPS_AT_LEAST = 100
_BINS = 1 << 16  # of the circle: five for each of the finest columns
_PART_AT_LEAST, _PART_AT_MOST = 0.4, 1.5  # of the commonest step: an encoder rounds (KITTI: 0.18 and 0.09 degrees)
_AROUND = (0.95, 1.05)  # of the columns that the mean of such steps makes; wider, rounded azimuths mirror the number
_SCANS_FOR_COLUMNS = 4  # about; one would do, if its street were full
_SCANS_AGREE = 3  # at least: within one scan, points of any turning sensor line up
_IN_COLUMNS = 0.2  # of 1 where all points of a scan lie at one place in their columns; 0.01 where they lie anywhere
_AGREE = 0.98  # of 1 where that place is the same in all scans; three that turn freely reach it once in 200 times
_ASIDE = 0.1  # of a column: less is the noise of azimuths
_STANDS_OUT = 8.0  # times what azimuths without a step reach


def firing_steps_deg(scans: Sequence[Points], rings: Sequence[Int64[np.ndarray, "_"]]) -> Float64[np.ndarray, "m"]:
    """Return the steps in azimuth between neighbouring points of one ring, with those across lost returns."""
    steps = []
    for points, ring in zip(scans, rings, strict=True):
        far = (points.range_m > _FAR_M) & (ring >= 0)
        order = np.lexsort((points.azimuth_deg[far], ring[far]))
        step, change = np.diff(points.azimuth_deg[far][order]), np.diff(ring[far][order])
        steps.append(step[(change == 0) & (step > _FINEST_DEG) & (step < 2 * _COARSEST_DEG)])
    return np.concatenate(steps)


def columns_of_scans(
    scans: Sequence[Points], rings: Sequence[Int64[np.ndarray, "_"]], steps_deg: Float64[np.ndarray, "m"]
) -> int | None:
    """Return the number of columns that fits the azimuths of every ring best; None if points have no neighbours.

    The Fourier coefficient of a ring's azimuths at frequency W is large where they are whole multiples of 360 / W
    degrees, however many of them are lost. The common steps tell where to look, and stand in where nothing lines up,
    as in motion-corrected scans.
    """
    if len(steps_deg) < _STEPS_AT_LEAST:
        return None
    counts, edges = np.histogram(np.log(steps_deg), bins=np.arange(np.log(_FINEST_DEG), np.log(_COARSEST_DEG), 0.02))
    smooth = np.convolve(counts, np.ones(5), mode="same")
    commonest_deg = float(np.exp(edges[int(np.argmax(smooth))] + 0.01))
    alike = (steps_deg > _PART_AT_LEAST * commonest_deg) & (steps_deg < _PART_AT_MOST * commonest_deg)
    if not alike.any():  # all steps are wider than the coarsest that is looked for
        return None
    usual = 360 / float(steps_deg[alike].mean())
    power, total = np.zeros(_BINS // 2 + 1), 0
    for points, ring in list(zip(scans, rings, strict=True))[:: max(1, len(scans) // _SCANS_FOR_COLUMNS)]:
        far = (points.range_m > _FAR_M) & (ring >= 0)
        azimuth_bin = np.minimum(((points.azimuth_deg[far] + 180) * (_BINS / 360)).astype(np.int64), _BINS - 1)
        for number in np.unique(ring[far]):
            on_circle = np.bincount(azimuth_bin[ring[far] == number], minlength=_BINS)
            power += np.abs(np.fft.rfft(on_circle)) ** 2
            total += int(on_circle.sum())
    low, high = int(_AROUND[0] * usual), min(int(_AROUND[1] * usual) + 1, len(power) - 1)
    columns = low + int(np.argmax(power[low : high + 1]))
    return columns if power[columns] > _STANDS_OUT * total else round(usual)


def first_edge_rad(scans: Sequence[Points], rings: Sequence[Int64[np.ndarray, "_"]], columns: int) -> float:
    """Return the azimuth at which the first of equal columns begins, so that points lie in the middle of columns.

    It is +pi where points do not line up with columns in the same way in all scans, as of a sensor that turns freely.
    """
    if len(scans) < _SCANS_AGREE:
        return math.pi
    places = []
    for points, ring in zip(scans, rings, strict=True):
        far = (points.range_m > _FAR_M) & (ring >= 0)
        places.append(np.exp(1j * columns * np.radians(points.azimuth_deg[far])).sum() / max(1, int(far.sum())))
    total, sizes = complex(sum(places)), np.abs(places)
    aside_rad = float(np.angle(-total * np.exp(-1j * columns * math.pi)))  # 2 pi for a whole column
    apart = float(sizes.mean()) < _IN_COLUMNS or abs(total) < _AGREE * float(sizes.sum())
    if apart or abs(aside_rad) < _ASIDE * 2 * math.pi:
        return math.pi
    return math.pi + aside_rad / columns


def offsets_deg(
    scans: Sequence[Points], rings: Sequence[Int64[np.ndarray, "_"]], count: int, lasers: int
) -> Float64[np.ndarray, "H"] | None:
    """Return each laser's azimuth offset from its firing, counter-clockwise, for files written column by column.

    Only files that keep an entry for every laser of a firing show it: the firing of a point is then its index in the
    file divided by the number of lasers.

    Args:
        rings: ring of each point, counted from 0; -1 for none.
        count: number of rings.
        lasers: number of entries of a firing in the files; some may never have returned.

    Returns:
        one number a ring, in the order of the rings' numbers; None if a laser has too few far points.
    """
    aside: list[list[np.ndarray]] = [[] for _ in range(count)]
    for points, ring in zip(scans, rings, strict=True):
        firing = points.index // lasers
        far = (points.range_m > _FAR_M) & (ring >= 0)
        azimuth = np.radians(points.azimuth_deg[far])
        east, north = (np.bincount(firing[far], part)[firing[far]] for part in (np.cos(azimuth), np.sin(azimuth)))
        off = (np.degrees(azimuth - np.arctan2(north, east)) + 180) % 360 - 180
        for number in range(count):
            aside[number].append(off[ring[far] == number])
    merged = [np.concatenate(parts) for parts in aside]
    if any(len(values) < 20 for values in merged):
        return None
    middle = np.array([np.median(values) for values in merged])
    return middle - np.median(middle)
