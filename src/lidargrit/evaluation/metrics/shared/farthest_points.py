"""Farthest point sampling: point clouds → the indices of a few points that lie far from one another."""

import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64

_BUCKET = 128  # points; the fastest of 64, 128, 256 for 65,536 points
_UNREACHED = np.float32(1e10)  # squared distance of a candidate before anything is chosen
_NEVER = np.float32(-1)  # of what is no candidate
# The bits of a number below 32, three bits apart: three such numbers interleave to one below 32768 (Morton's order).
_SPACED_BITS = np.array(
    [sum((value >> bit & 1) << 3 * bit for bit in range(5)) for value in range(32)], dtype=np.uint16
)


def farthest_points(
    points: Float32[np.ndarray, "B n 3"],
    candidates: Bool[np.ndarray, "B n"],
    num: int,
    start: int | None = None,
    precedence: Int64[np.ndarray, " n"] | None = None,
) -> Int64[np.ndarray, "B {num}"]:
    """Choose, again and again, the candidate whose nearest chosen point is farthest away.

    Points are kept in buckets that are small in space. A newly chosen point can only change the distances in buckets
    whose box is nearer to it than the farthest of their points is to its nearest chosen one; all others are skipped.
    The result, in single precision, is that of the plain loop over all points to the last bit: rounding keeps order,
    so the distance to a box never exceeds that to a point in it.

    Args:
        points: coordinates of the points of B clouds.
        candidates: whether each point may be chosen. If none is left, the first point in precedence is taken.
        num: number of points to choose from each cloud.
        start: index of the first point, which need not be a candidate. Without it the origin counts as chosen but is
            not part of the result, which then begins with the candidate farthest from it.
        precedence: all indices, in the order in which equally far points are taken; ascending by default.

    Source:
        Eldar et al., The farthest point strategy for progressive image sampling, IEEE Trans. Image Processing 6(9),
        1997; skipping buckets: Han et al., QuickFPS, IEEE Trans. Computer-Aided Design 42(11), 2023.
    """
    clouds, n = points.shape[:2]
    precedence = np.arange(n) if precedence is None else precedence
    rank = _buckets(points[:, precedence], candidates[:, precedence])  # (B, buckets, points)
    members = rank.shape[1:]
    position = precedence[rank] + n * np.arange(clouds)[:, None, None]
    axes = [points[..., axis].ravel()[position].reshape(-1, members[1]) for axis in range(3)]
    free = candidates.ravel()[position].reshape(-1, members[1])
    rank = rank.reshape(-1, members[1])
    squared = np.where(free, _UNREACHED, _NEVER)  # of every point to its nearest chosen one
    low, high = _boxes(axes, free, clouds)
    best_at = squared.argmax(axis=1)
    best, best_rank = (table[np.arange(len(table)), best_at] for table in (squared, rank))
    chosen = np.zeros((clouds, num), dtype=np.int64)
    last = np.zeros((clouds, 3), dtype=np.float32) if start is None else points[:, start]
    for k in range(num):
        if k == 0 and start is not None:
            chosen[:, 0] = start
            continue
        gap = np.maximum(low - last.T[..., None], last.T[..., None] - high)
        gap = np.square(np.maximum(gap, 0, out=gap), out=gap)
        near = np.flatnonzero((gap[0] + gap[1] + gap[2]).ravel() < best)
        new = _squared_distances([axis[near] for axis in axes], last[near // members[0]])
        new = np.minimum(new, squared[near], out=new)
        squared[near] = new
        best_at = new.argmax(axis=1)
        best[near], best_rank[near] = new[np.arange(len(near)), best_at], rank[near, best_at]
        by_cloud = best.reshape(clouds, -1)
        winner = by_cloud == by_cloud.max(axis=1, keepdims=True)
        first = np.where(winner, best_rank.reshape(clouds, -1), np.int32(n)).min(axis=1)
        chosen[:, k] = precedence[first]
        last = points[np.arange(clouds), chosen[:, k]]
    return chosen


def _boxes(
    axes: list[Float32[np.ndarray, "buckets points"]], free: Bool[np.ndarray, "buckets points"], clouds: int
) -> tuple[Float32[np.ndarray, "3 B _"], Float32[np.ndarray, "3 B _"]]:
    """Return the least and the greatest coordinates of the candidates of every bucket."""
    least = [np.where(free, along, np.float32(np.inf)).min(axis=1).reshape(clouds, -1) for along in axes]
    greatest = [np.where(free, along, np.float32(-np.inf)).max(axis=1).reshape(clouds, -1) for along in axes]
    return np.stack(least), np.stack(greatest)


def _squared_distances(
    axes: list[Float32[np.ndarray, "buckets points"]], origin: Float32[np.ndarray, "buckets 3"]
) -> Float32[np.ndarray, "buckets points"]:
    """Return the squared distances of the points of each bucket to one point; the coordinates are overwritten."""
    for along, start in zip(axes, origin.T, strict=True):
        np.subtract(along, start[:, None], out=along)
        np.square(along, out=along)
    axes[0] += axes[1]
    axes[0] += axes[2]
    return axes[0]


def _buckets(
    points: Float32[np.ndarray, "B n 3"], candidates: Bool[np.ndarray, "B n"]
) -> Int32[np.ndarray, "B buckets points"]:
    """Return the indices of the points of every bucket, ascending; what is no candidate comes last, in own buckets.

    Points are sorted along a space-filling curve and cut into runs. Roots of coordinates are compared, for a scan is
    densest near the sensor. Index 0 fills up the last bucket: to have a point twice changes nothing.
    """
    scale = np.abs(points).max(initial=np.float32(1e-30))
    key = np.zeros(points.shape[:2], dtype=np.uint16)
    for axis in range(3):
        ratio = points[..., axis] / scale
        root = np.copysign(np.sqrt(np.abs(ratio)), ratio)
        key |= _SPACED_BITS[(root * np.float32(15.99) + 16).astype(np.uint8)] << np.uint16(axis)
    key[~candidates] = 2**15  # after all others
    order = np.argsort(key, axis=1, kind="stable").astype(np.int32)
    filled = np.pad(order, ((0, 0), (0, -order.shape[1] % _BUCKET)))
    return np.sort(filled.reshape(len(filled), -1, _BUCKET), axis=2)
