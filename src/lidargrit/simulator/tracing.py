"""Ray casting: triangles, kept objects and rays → range, triangle and incidence."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float32, Float64, Int32

from lidargrit.simulator.mesh import Mesh, Objects
from lidargrit.simulator.ray_windows import SortedRays, Windows

_MARGIN_RAD = 0.01  # for the width of beams, and for the turn of a car during a revolution
_LARGEST_M = 30.0  # no kept object reaches farther from its foot
NOTHING = -1  # the triangle of a ray that meets none


@dataclass(frozen=True, eq=False)
class Hits:
    """The first hit of every ray.

    Args:
        range_m: distance to the hit along the ray in metres, infinite where nothing is hit.
        triangle: index of the mesh's triangle that is hit, or NOTHING. The parts of kept objects follow the triangles,
            object after object: an index of a part stands for all its triangles.
        cos_incidence: cosine between the ray and the triangle's normal, 0 to 1; 0 where nothing is hit.
    """

    range_m: Float32[np.ndarray, " n"]
    triangle: Int32[np.ndarray, " n"]
    cos_incidence: Float32[np.ndarray, " n"]


def in_reach(
    mesh: Mesh, poses: Sequence[Float64[np.ndarray, "4 4"]], elevations_rad: tuple[float, float], range_max_m: float
) -> Mesh:
    """Leave out triangles that no ray can meet: too far, or wholly above or below all rays.

    Embree takes longer to add a triangle than to find out that a ray misses it.

    Args:
        mesh: triangles in the scene's frame.
        poses: sensor poses at the beginning and the end of the revolution.
        elevations_rad: elevations of the lowest and the highest ray.
        range_max_m: longest range of interest.
    """
    corners = mesh.triangles_m.reshape(-1, 3)
    longest_m = float(np.abs(np.diff(mesh.triangles_m, axis=1)).max()) * 4  # not below any side's length
    reach_squared = np.float32(range_max_m**2 + longest_m**2)  # a triangle with corners beyond stays beyond the range
    keep = np.zeros(len(mesh), bool)
    for pose in poses:
        seen = corners - pose[:3, 3].astype(np.float32)
        height, squared = seen @ pose[:3, 2].astype(np.float32), np.einsum("ni,ni->n", seen, seen)
        # Above an upright cone space is convex, so a triangle lies there if its corners do; likewise below.
        beyond = [squared > reach_squared]
        for side, limit_rad in ((-1, -elevations_rad[0]), (1, elevations_rad[1])):
            sine = np.float32(np.sin(limit_rad + _MARGIN_RAD))
            if limit_rad + _MARGIN_RAD > 0:
                beyond.append(height * abs(height) * side > sine * sine * squared)
        keep |= ~np.logical_or.reduce([b[0::3] & b[1::3] & b[2::3] for b in beyond])
    return Mesh(*(getattr(mesh, field.name)[keep] for field in fields(Mesh)))


def objects_in_reach(objects: Objects, poses: Sequence[Float64[np.ndarray, "4 4"]], range_max_m: float) -> Objects:
    """Leave out objects that stand farther away than the longest range of interest, whichever pose counts."""
    reach_m = range_max_m + _LARGEST_M
    apart_m = [np.linalg.norm(objects.frame[:, :3, 3] - pose[:3, 3], axis=1) for pose in poses]
    return objects.select(np.min(apart_m, axis=0) < reach_m)


class Tracer:
    """Casts rays at the triangles of a mesh and at kept objects, in the thread that calls.

    Args:
        mesh: triangles that rays can hit.
        reach_m: longest range at which a hit counts.
        objects: kept objects.
    """

    def __init__(self, mesh: Mesh, reach_m: float = float("inf"), objects: Objects | None = None) -> None:
        self._reach_m = min(reach_m, 1e30)  # Embree's own infinity is about 1e37
        self._mesh = mesh.kept
        self._objects = objects or Objects.none()
        self._windows: Windows | None = None
        self._first_part = (len(mesh) + self._objects.first_part()).tolist()

    def cast(
        self,
        origins_m: Float32[np.ndarray, "n 3"],
        directions: Float32[np.ndarray, "n 3"],
        beyond_m: Float32[np.ndarray, " n"] | None = None,
    ) -> Hits:
        """Find the first hit of every ray.

        Args:
            directions: unit direction vectors of the rays.
            beyond_m: ranges up to which hits do not count; 0 if not given.
        """
        if len(directions) == 0:
            return Hits(np.empty(0, np.float32), np.empty(0, np.int32), np.empty(0, np.float32))
        rays = SortedRays(directions)
        order, sorted_ = rays.order, directions[rays.order]
        beyond = np.zeros(len(order), np.float32) if beyond_m is None else beyond_m[order]
        start_m = origins_m[order] + sorted_ * beyond[:, None]
        range_m, triangle, normal = self._mesh.cast(start_m, sorted_, np.float32(self._reach_m) - beyond)
        range_m[triangle < 0] = self._reach_m
        range_m += beyond
        if len(self._objects):
            self._cast_at_objects(
                self._windows_from(origins_m), rays, (start_m, sorted_, beyond), (range_m, triangle, normal)
            )
        hits = Hits(np.empty_like(range_m), np.empty_like(triangle), np.empty_like(range_m))
        missed = triangle < 0
        range_m[missed], normal[missed] = np.inf, 0  # the normal is not written there
        length = np.sqrt(np.einsum("ni,ni->n", normal, normal))
        cos = np.abs(np.einsum("ni,ni->n", normal, sorted_)) / np.maximum(length, np.float32(1e-30))
        hits.range_m[order], hits.triangle[order] = range_m, triangle
        hits.cos_incidence[order] = np.minimum(cos, np.float32(1))
        return hits

    def _windows_from(self, origins_m: Float32[np.ndarray, "n 3"]) -> Windows:
        """Return the windows of a revolution's rays, which are those of its parts too."""
        bounds = np.array([(axis.min(), axis.max()) for axis in origins_m.T]).T
        if self._windows is None or not self._windows.hold_for(bounds):
            self._windows = Windows.of(self._objects, bounds)
        return self._windows

    def _cast_at_objects(
        self, windows: Windows, rays: SortedRays, cast: tuple[np.ndarray, ...], found: tuple[np.ndarray, ...]
    ) -> None:
        """Write nearer hits on kept objects into what was found; the nearest objects come first, and spare the rest.

        Args:
            windows: bounds of the rays that can meet each object.
            rays: the rays in the order of all that follows.
            cast: starting point (n, 3), direction (n, 3) and range at the start (n) of each ray.
            found: range (n), triangle (n), and normal (n, 3) of the hit of each ray so far.
        """
        start_m, directions, beyond_m = cast
        range_m, triangle, normal = found
        back = np.linalg.inv(self._objects.frame)[:, :3, :3].astype(np.float32)
        into = back.swapaxes(1, 2).copy()  # of rows of vectors
        at_m = self._objects.frame[:, :3, 3].astype(np.float32)
        nearest_m, slopes = windows.nearest_m.tolist(), windows.slope.tolist()
        objects, spans = rays.slices(windows)
        near_first = np.argsort(windows.nearest_m[objects], kind="stable")
        for which, (first, last) in zip(objects[near_first].tolist(), spans[near_first].tolist(), strict=True):
            nearest, (low, high) = nearest_m[which], slopes[which]
            if nearest > self._reach_m:
                break
            slope = rays.slope[first:last]
            ray = ((slope >= low) & (slope <= high) & (range_m[first:last] > nearest)).nonzero()[0]
            if len(ray) == 0:
                continue
            ray += first
            start, direction = (start_m[ray] - at_m[which]) @ into[which], directions[ray] @ into[which]
            shape, begun_m = self._objects.shapes[which], beyond_m[ray]
            further_m, met, facing = shape.kept.cast(start, direction, range_m[ray] - begun_m)
            nearer = (met >= 0).nonzero()[0]
            if len(nearer) == 0:
                continue
            ray = ray[nearer]
            range_m[ray] = further_m[nearer] + begun_m[nearer]
            triangle[ray] = shape.part[met[nearer]].astype(np.int32) + self._first_part[which]
            normal[ray] = facing[nearer] @ back[which]  # normals turn by the inverse's transpose

    def cast_through(
        self,
        origins_m: Float32[np.ndarray, "n 3"],
        directions: Float32[np.ndarray, "n 3"],
        first: Hits,
        passes: Float32[np.ndarray, " t"],
    ) -> tuple[Hits, Float32[np.ndarray, " n"]]:
        """Follow rays that met a pane to what stands behind it, through two panes at most: the windows of a car.

        Args:
            directions: unit direction vectors of the rays.
            first: first hit of each ray; a ray that hits no glass ends there.
            passes: share of light that passes each triangle; the last entry is for NOTHING.

        Returns:
            what each meets last, with the range from its origin, and the share of its light that gets there and back.
        """
        range_m, triangle, cos = first.range_m.copy(), first.triangle.copy(), first.cos_incidence.copy()
        light = np.ones(len(range_m), np.float32)
        for _ in range(2):
            on = np.flatnonzero(passes[triangle] > 0)
            if len(on) == 0:
                break
            light[on] *= passes[triangle[on]] ** 2
            skin = range_m[on] + np.float32(1e-3)  # a millimetre behind the pane, not to meet it again
            behind = self.cast(origins_m[on], directions[on], skin)
            range_m[on], triangle[on], cos[on] = behind.range_m, behind.triangle, behind.cos_incidence
        return Hits(range_m, triangle, cos), light
