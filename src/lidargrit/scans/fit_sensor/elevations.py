"""Points and their rings → the elevation of every row, or the rows themselves where rings are not known."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks

_BIN_DEG = 0.005  # finer than the accuracy of any sensor's table
_WIDTHS_DEG = (0.4, 0.3, 0.2, 0.15, 0.1, 0.07, 0.05, 0.03, 0.02, 0.01)  # of the smoothing, tried in turn
_FAR_M = 8.0  # at which a point counts half: parallax and rounding of coordinates blur the angles of nearer ones
_AGREE_AT_LEAST = 0.75  # of the points near a row; points without rows reach 0.5
_HEIGHT_AT_MOST_M = 0.5  # of a laser above or below the origin; a larger one is not the sensor's
_SHARPER_AT_LEAST = 2.0  # times, by which the points of a ring gather more closely where its height is real
_SHARPER_SHARE = 0.25  # of the rings, before heights are believed; rings at one range do not show theirs
_STEPS = 12  # of the robust fit; it stands still after eight


@dataclass(frozen=True, eq=False)
class FittedRows:
    """The rows of a sensor, from the top.

    Args:
        elevation_deg: elevation at which a row's points are seen from the origin, at the range where most of them are.
        laser_elevation_deg: elevation of the laser itself, which the elevations of far points approach.
        laser_height_m: height of the laser above the origin; all 0 if it is not found.
        residual_deg: robust standard deviation of the elevations of a row's points.
        num_points: number of points of every row (H,).
        agree_share: share of all points that lie within a quarter of the row spacing of their row.
        number: index of every row among the given rings.
    """

    elevation_deg: Float64[np.ndarray, "H"]
    laser_elevation_deg: Float64[np.ndarray, "H"]
    laser_height_m: Float64[np.ndarray, "H"]
    residual_deg: Float64[np.ndarray, "H"]
    num_points: Int64[np.ndarray, "H"]
    agree_share: float
    number: Int64[np.ndarray, "H"]


def rows_of_rings(
    elevation_deg: Float64[np.ndarray, "n"], range_m: Float64[np.ndarray, "n"], ring: Int64[np.ndarray, "n"]
) -> FittedRows:
    """Fit elevation = laser + height / range to the points of every ring, robustly, and sort the rows from the top.

    Lasers sit centimetres above one another, so that a near point is seen higher or lower than a far one. Where the
    heights do not make the rings sharper they are taken as 0, which leaves the median.
    """
    numbers = np.unique(ring)
    order = np.argsort(ring, kind="stable")
    groups = np.split(order, np.searchsorted(ring[order], numbers[1:]))
    level, tilted = np.zeros((len(groups), 2)), np.zeros((len(groups), 2))
    spread = np.zeros((len(groups), 2))
    for index, group in enumerate(groups):
        level[index], spread[index, 0] = _fit(elevation_deg[group], range_m[group], with_height=False)
        tilted[index], spread[index, 1] = _fit(elevation_deg[group], range_m[group], with_height=True)
    height_m = np.radians(tilted[:, 1])
    sharper = (spread[:, 0] > _SHARPER_AT_LEAST * spread[:, 1]) & (np.abs(height_m) < _HEIGHT_AT_MOST_M)
    fit, left = level, spread[:, 0]
    if sharper.mean() > _SHARPER_SHARE:
        fit, left = np.where(sharper[:, None], tilted, level), np.where(sharper, spread[:, 1], spread[:, 0])
    usual_m = np.array([np.median(range_m[group]) for group in groups])
    seen_deg = fit[:, 0] + fit[:, 1] / usual_m
    top_down = np.argsort(-seen_deg, kind="stable")
    quarter_gap_deg = _quarter_gap_deg(seen_deg[top_down])[np.argsort(top_down)]
    near = [
        np.abs(elevation_deg[group] - fit[i, 0] - fit[i, 1] / range_m[group]) < quarter_gap_deg[i]
        for i, group in enumerate(groups)
    ]
    return FittedRows(
        seen_deg[top_down],
        fit[top_down, 0],
        np.radians(fit[top_down, 1]),
        left[top_down],
        np.array([len(group) for group in groups])[top_down],
        float(np.concatenate(near).mean()),
        numbers[top_down],
    )


def _fit(
    elevation_deg: Float64[np.ndarray, "n"], range_m: Float64[np.ndarray, "n"], with_height: bool
) -> tuple[Float64[np.ndarray, "2"], float]:
    """Return the line of elevation over 1 / range by weights that fall for far-off points, and the spread around it."""
    inverse = 1 / range_m if with_height else np.zeros_like(range_m)
    trust = range_m**2 / (range_m**2 + _FAR_M**2)
    weight = trust.copy()
    line = np.array([np.median(elevation_deg), 0.0])
    spread = math.inf
    for _ in range(_STEPS):
        centre_x, centre_y = np.average(inverse, weights=weight), np.average(elevation_deg, weights=weight)
        across = float(weight @ (inverse - centre_x) ** 2)
        slope = float(weight @ ((inverse - centre_x) * (elevation_deg - centre_y))) / across if across > 1e-12 else 0.0
        line = np.array([centre_y - slope * centre_x, slope])
        off = np.abs(elevation_deg - line[0] - line[1] * inverse)
        spread = 1.4826 * float(np.median(off))
        weight = trust / (1 + (off / (2 * spread + 1e-6)) ** 2) ** 2
    return line, spread


def cluster_rows(
    elevation_deg: Float64[np.ndarray, "n"], range_m: Float64[np.ndarray, "n"]
) -> tuple[Float64[np.ndarray, "H"], float]:
    """Find rows as the peaks of a histogram of elevations, for points whose order is lost.

    The histogram is smoothed ever less; the smoothing under which the most points lie near a peak is taken.

    Returns:
        elevations in degrees, falling, and the share of points that lie nearer to a row than a quarter of the way to
        the next; no rows if there is no smoothing that fits.
    """
    trust = range_m**2 / (range_m**2 + _FAR_M**2)
    low, high = float(elevation_deg.min()) - 1, float(elevation_deg.max()) + 1
    bins = max(16, int((high - low) / _BIN_DEG))
    counts, edges = np.histogram(elevation_deg, bins=bins, range=(low, high), weights=trust)
    middles = (edges[1:] + edges[:-1]) / 2
    best, best_share = np.zeros(0), 0.0
    for width in _WIDTHS_DEG:
        smooth = gaussian_filter1d(counts, width / _BIN_DEG, mode="constant")
        peaks, _ = find_peaks(smooth, height=0.02 * smooth.max(), prominence=0.01 * smooth.max())
        rows = middles[peaks][::-1]
        if len(rows) < 2 or len(rows) > 256:
            continue
        share = _share_near(elevation_deg, trust, rows)
        if share >= max(_AGREE_AT_LEAST, best_share):
            best, best_share = rows, share
    return best, best_share


def nearest_row(elevation_deg: Float64[np.ndarray, "n"], rows_deg: Float64[np.ndarray, "H"]) -> Int64[np.ndarray, "n"]:
    """Return the row of falling elevations that lies nearest to each point."""
    edges = -(rows_deg[1:] + rows_deg[:-1]) / 2
    return np.searchsorted(edges, -elevation_deg)


def _share_near(
    elevation_deg: Float64[np.ndarray, "n"], trust: Float64[np.ndarray, "n"], rows_deg: Float64[np.ndarray, "H"]
) -> float:
    row = nearest_row(elevation_deg, rows_deg)
    near = np.abs(elevation_deg - rows_deg[row]) < _quarter_gap_deg(rows_deg)[row]
    return float(np.average(near, weights=trust))


def _quarter_gap_deg(rows_deg: Float64[np.ndarray, "H"]) -> Float64[np.ndarray, "H"]:
    """Return a quarter of the way from every row to its nearer neighbour."""
    gap = np.abs(np.diff(rows_deg))
    return np.minimum(np.append(gap, math.inf), np.insert(gap, 0, math.inf)) / 4 if len(gap) else np.ones(1)
