"""Windows of rays: objects and rays → for each object, those rays that its box can stop."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

from lidargrit.simulator.mesh import Objects

_STEPS = 1 << 16  # azimuths are sorted by their 16-bit step, which takes one pass
_SPARE_M = 0.01  # for the rounding of corners


@dataclass(frozen=True, eq=False)
class Windows:
    """Bounds of the rays that can meet each object, whichever origin they have.

    Args:
        nearest_m: distance from the nearest origin to the object's box, or less.
        azimuth_rad: azimuth of the object's middle.
        half_rad: half the width of the window; pi for a box around an origin.
        slope: lowest and highest ratio of height to way over the ground.
    """

    nearest_m: Float32[np.ndarray, " n"]
    azimuth_rad: Float64[np.ndarray, " n"]
    half_rad: Float64[np.ndarray, " n"]
    slope: Float32[np.ndarray, "n 2"]

    @classmethod
    def of(cls, objects: Objects, origins_m: Float32[np.ndarray, "r 3"]) -> "Windows":
        """Bound boxes as they are seen from the middle of all origins, and widen that by the farthest origin.

        A ray from an origin that lies aside by no more than a radius meets a box only if a parallel ray from the
        middle meets the box within that radius. So sensors that move during a revolution need nothing more.
        """
        low, high = origins_m.min(axis=0).astype(np.float64), origins_m.max(axis=0).astype(np.float64)
        middle, aside_m = (low + high) / 2, float(np.linalg.norm(high - low)) / 2 + _SPARE_M
        box = np.stack([shape.box_m for shape in objects.shapes])  # (n, 2, 3)
        pick = np.array([(i >> 2 & 1, i >> 1 & 1, i & 1) for i in range(8)])
        local = box[:, pick, np.arange(3)]  # (n, 8, 3)
        corner = np.einsum("nij,nkj->nki", objects.frame[:, :3, :3], local) + objects.frame[:, None, :3, 3] - middle
        centre = corner.mean(axis=1)
        radius = np.linalg.norm(corner[..., :2] - centre[:, None, :2], axis=-1).max(axis=1)
        away = np.hypot(centre[:, 0], centre[:, 1])
        apart = away - radius - aside_m
        around = apart <= _SPARE_M
        azimuth = np.arctan2(centre[:, 1], centre[:, 0])
        far = np.hypot(corner[..., 0], corner[..., 1])
        turn = np.arctan2(corner[..., 1], corner[..., 0]) - azimuth[:, None]
        turn = np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
        turn += np.arcsin(np.minimum(aside_m / np.maximum(far, aside_m), 1))
        half = np.where(around, np.pi, turn.max(axis=1))
        bottom, top = corner[..., 2].min(axis=1) - aside_m, corner[..., 2].max(axis=1) + aside_m
        flat = np.stack((np.maximum(apart, _SPARE_M), away + radius + aside_m))
        slope = np.stack(((bottom / flat).min(axis=0), (top / flat).max(axis=0)), axis=1)
        slope[around] = -np.inf, np.inf
        upright = np.maximum(np.maximum(bottom, -top), 0)
        nearest = np.where(around, 0, np.hypot(np.maximum(apart, 0), upright))
        return cls(nearest.astype(np.float32), azimuth, half, slope.astype(np.float32))


class SortedRays:
    """Rays by azimuth.

    Args:
        directions: vectors of the rays.
    """

    def __init__(self, directions: Float32[np.ndarray, "n 3"]) -> None:
        azimuth = np.arctan2(directions[:, 1], directions[:, 0])
        step = ((azimuth + np.float32(np.pi)) * np.float32(_STEPS / (2 * np.pi))).astype(np.int32)
        step = np.minimum(step, _STEPS - 1).astype(np.uint16)
        self._order = np.argsort(step, kind="stable")
        self._step = step[self._order]
        sorted_ = directions[self._order]
        flat = np.sqrt(sorted_[:, 0] ** 2 + sorted_[:, 1] ** 2)
        self._slope = sorted_[:, 2] / np.maximum(flat, np.float32(1e-9))

    def within(self, windows: Windows, which: int) -> Int64[np.ndarray, " m"]:
        """Return the indices of the rays that lie in the window of one object."""
        low, high = windows.slope[which]
        parts = []
        for start, stop in self._spans(windows.azimuth_rad[which], windows.half_rad[which]):
            slope = self._slope[start:stop]
            parts.append(self._order[start:stop][(slope >= low) & (slope <= high)])
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _spans(self, azimuth_rad: float, half_rad: float) -> list[tuple[int, int]]:
        """Return where rays of an interval of azimuth begin and end: two spans where it wraps."""
        scale = _STEPS / (2 * np.pi)
        low, high = (int(np.floor((azimuth_rad + np.pi + side * half_rad) * scale)) + side for side in (-1, 1))
        if high - low >= _STEPS:
            return [(0, len(self._step))]
        low, high = low % _STEPS, high % _STEPS
        start, stop = np.searchsorted(self._step, np.array([low, high], np.uint16), side="left")
        stop = int(np.searchsorted(self._step, np.uint16(high), side="right"))
        return [(int(start), stop)] if low <= high else [(int(start), len(self._step)), (0, stop)]
