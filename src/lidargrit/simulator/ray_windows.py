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
        origins_m: lowest and highest coordinates of the origins.
    """

    nearest_m: Float32[np.ndarray, " n"]
    azimuth_rad: Float64[np.ndarray, " n"]
    half_rad: Float64[np.ndarray, " n"]
    slope: Float32[np.ndarray, "n 2"]
    origins_m: Float32[np.ndarray, "2 3"]

    @classmethod
    def of(cls, objects: Objects, origins_m: Float32[np.ndarray, "2 3"]) -> "Windows":
        """Bound boxes as they are seen from the middle of all origins, and widen that by the farthest origin.

        A ray from an origin that lies aside by no more than a radius meets a box only if a parallel ray from the
        middle meets the box within that radius. So sensors that move during a revolution need nothing more.

        Args:
            origins_m: lowest and highest coordinates of the origins.
        """
        low, high = origins_m.astype(np.float64)
        middle, aside_m = (low + high) / 2, float(np.linalg.norm(high - low)) / 2 + _SPARE_M
        box = np.stack([shape.box_m for shape in objects.shapes])  # (n, 2, 3)
        pick = np.array([(i >> 2 & 1, i >> 1 & 1, i & 1) for i in range(8)])
        local = box[:, pick, np.arange(3)]  # (n, 8, 3)
        corner = np.einsum("nij,nkj->nki", objects.frame[:, :3, :3], local) + objects.frame[:, None, :3, 3] - middle
        centre = corner.mean(axis=1)
        radius = np.linalg.norm(corner[..., :2] - centre[:, None, :2], axis=-1).max(axis=1)
        away = np.hypot(centre[:, 0], centre[:, 1])
        apart = np.maximum(_gaps_m(objects.frame, box, middle), away - radius) - aside_m
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
        return cls(nearest.astype(np.float32), azimuth, half, slope.astype(np.float32), origins_m)

    def hold_for(self, origins_m: Float32[np.ndarray, "2 3"]) -> bool:
        """Return whether origins between some bounds lie within those that were foreseen."""
        return bool((origins_m[0] >= self.origins_m[0]).all() and (origins_m[1] <= self.origins_m[1]).all())


def _gaps_m(
    frame: Float64[np.ndarray, "n 4 4"], box_m: Float64[np.ndarray, "n 2 3"], eye_m: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, " n"]:
    """Return how far an eye stands from upright boxes, over the ground; frames turn and stretch, heights may shear."""
    stretch = np.linalg.norm(frame[:, :2, :2], axis=1)
    local = np.einsum("nij,ni->nj", frame[:, :2, :2], eye_m[:2] - frame[:, :2, 3]) / stretch
    low, high = box_m[:, 0, :2] * stretch, box_m[:, 1, :2] * stretch
    return np.linalg.norm(np.maximum(np.maximum(low - local, local - high), 0), axis=1)


class SortedRays:
    """Rays in the order of their azimuths, so that a window is a slice.

    Args:
        directions: vectors of the rays.
    """

    def __init__(self, directions: Float32[np.ndarray, "n 3"]) -> None:
        azimuth = np.arctan2(directions[:, 1], directions[:, 0])
        step = ((azimuth + np.float32(np.pi)) * np.float32(_STEPS / (2 * np.pi))).astype(np.int32)
        step = np.minimum(step, _STEPS - 1).astype(np.uint16)
        self.order = np.argsort(step, kind="stable")
        self._step = step[self.order].astype(np.int64)
        flat = np.sqrt(directions[:, 0] ** 2 + directions[:, 1] ** 2)
        self.slope = (directions[:, 2] / np.maximum(flat, np.float32(1e-9)))[self.order]

    def slices(self, windows: Windows) -> tuple[Int64[np.ndarray, " s"], Int64[np.ndarray, "s 2"]]:
        """Return objects, and from where to where rays lie in the azimuths of each; a window that wraps has two."""
        scale = _STEPS / (2 * np.pi)
        middle, half = (windows.azimuth_rad + np.pi) * scale, windows.half_rad * scale
        low, high = np.floor(middle - half) - 1, np.floor(middle + half) + 1
        every = high - low >= _STEPS
        low, high = np.where(every, 0, low), np.where(every, _STEPS - 1, high)
        objects, spans = [], []
        for turn in (-_STEPS, 0, _STEPS):
            start = np.searchsorted(self._step, low + turn, side="left")
            stop = np.searchsorted(self._step, high + turn, side="right")
            some = np.flatnonzero(stop > start)
            objects.append(some)
            spans.append(np.stack((start, stop), axis=1)[some])
        return np.concatenate(objects), np.concatenate(spans)
