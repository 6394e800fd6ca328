"""Ray casting: triangles, kept objects and rays → range, triangle and incidence."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float32, Float64, Int32

from lidargrit.simulator.embree import EmbreeTriangles
from lidargrit.simulator.mesh import Mesh, Objects
from lidargrit.simulator.ray_windows import SortedRays, Windows

_MARGIN_RAD = 0.01  # for the width of beams, and for the turn of a car during a revolution
NOTHING = -1  # the triangle of a ray that meets none


@dataclass(frozen=True, eq=False)
class Hits:
    """The first hit of every ray.

    Args:
        range_m: distance to the hit along the ray in metres, infinite where nothing is hit.
        triangle: index of the triangle that is hit, or NOTHING.
        cos_incidence: cosine between the ray and the triangle's normal, 0 to 1; 0 where nothing is hit.
    """

    range_m: Float32[np.ndarray, " n"]
    triangle: Int32[np.ndarray, " n"]
    cos_incidence: Float32[np.ndarray, " n"]


def in_reach(
    mesh: Mesh,
    poses: Sequence[Float64[np.ndarray, "4 4"]],
    elevations_rad: tuple[float, float],
    range_max_m: float,
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
    origins_m = np.stack([pose[:3, 3] for pose in poses]).astype(np.float32)
    return objects.select(Windows.of(objects, origins_m).nearest_m < range_max_m) if len(objects) else objects


class Tracer:
    """Casts rays at the triangles of a mesh and at kept objects, in the thread that calls.

    Args:
        mesh: triangles that rays can hit.
        reach_m: longest range at which a hit counts.
        objects: kept objects; the indices of their triangles follow those of the mesh, object after object.
    """

    def __init__(self, mesh: Mesh, reach_m: float = float("inf"), objects: Objects | None = None) -> None:
        self._reach_m = min(reach_m, 1e30)  # Embree's own infinity is about 1e37
        self._mesh = EmbreeTriangles(mesh.triangles_m)
        self._objects = objects or Objects.none()
        counts = [len(mesh), *(len(shape) for shape in self._objects.shapes)]
        self._first_triangle = np.cumsum(counts)[:-1].astype(np.int32)

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
        start_m = origins_m if beyond_m is None else origins_m + directions * beyond_m[:, None]
        within_m = self._reach_m if beyond_m is None else np.float32(self._reach_m) - beyond_m
        range_m, triangle, normal = self._mesh.cast(start_m, directions, within_m)
        if beyond_m is not None:
            range_m += beyond_m
        missed = triangle < 0
        cos = _cosines(normal, directions, normal)
        cos[missed] = 0  # the normal is not written there
        hits = Hits(range_m, triangle, cos)
        if len(self._objects):
            range_m[missed] = self._reach_m
            self._cast_at_objects(origins_m, start_m, directions, beyond_m, hits)
            missed = hits.triangle < 0
        range_m[missed] = np.inf
        return hits

    def _cast_at_objects(
        self,
        origins_m: Float32[np.ndarray, "n 3"],
        start_m: Float32[np.ndarray, "n 3"],
        directions: Float32[np.ndarray, "n 3"],
        beyond_m: Float32[np.ndarray, " n"] | None,
        hits: Hits,
    ) -> None:
        """Write nearer hits on kept objects into hits; the nearest objects come first, and spare rays at the rest."""
        windows = Windows.of(self._objects, origins_m)
        order = np.argsort(windows.nearest_m)
        rays = SortedRays(directions)
        back = np.linalg.inv(self._objects.frame).astype(np.float32)
        at_m = self._objects.frame[:, :3, 3].astype(np.float32)
        for which in order[windows.nearest_m[order] < self._reach_m]:
            ray = rays.within(windows, which)
            ray = ray[hits.range_m[ray] > windows.nearest_m[which]]
            if len(ray) == 0:
                continue
            turn = back[which, :3, :3]
            start, direction = (start_m[ray] - at_m[which]) @ turn.T, directions[ray] @ turn.T
            begun_m = 0 if beyond_m is None else beyond_m[ray]
            range_m, triangle, normal = self._objects.shapes[which].kept.cast(
                start, direction, hits.range_m[ray] - begun_m
            )
            met = np.flatnonzero(triangle >= 0)
            if len(met) == 0:
                continue
            ray, normal = ray[met], normal[met]
            hits.range_m[ray] = (range_m + begun_m)[met]
            hits.triangle[ray] = triangle[met] + self._first_triangle[which]
            # Normals turn by the inverse's transpose.
            hits.cos_incidence[ray] = _cosines(normal, direction[met], normal @ turn)

    def cast_through(
        self,
        origins_m: Float32[np.ndarray, "n 3"],
        directions: Float32[np.ndarray, "n 3"],
        first: Hits,
        passes: Float32[np.ndarray, " t"],
        at_most: int = 2,
    ) -> tuple[Hits, Float32[np.ndarray, " n"]]:
        """Follow rays that met a pane to what stands behind it, through a few panes at most.

        Args:
            directions: unit direction vectors of the rays.
            first: first hit of each ray; a ray that hits no glass ends there.
            passes: share of light that passes each triangle; the last entry is for NOTHING.
            at_most: largest number of panes that a ray passes; 2 for the two windows of a car.

        Returns:
            what each meets last, with the range from its origin, and the share of its light that gets there and back.
        """
        range_m, triangle, cos = first.range_m.copy(), first.triangle.copy(), first.cos_incidence.copy()
        light = np.ones(len(range_m), np.float32)
        for _ in range(at_most):
            on = np.flatnonzero(passes[triangle] > 0)
            if len(on) == 0:
                break
            light[on] *= passes[triangle[on]] ** 2
            skin = range_m[on] + np.float32(1e-3)  # a millimetre behind the pane, not to meet it again
            behind = self.cast(origins_m[on], directions[on], skin)
            range_m[on], triangle[on], cos[on] = behind.range_m, behind.triangle, behind.cos_incidence
        return Hits(range_m, triangle, cos), light


def _cosines(
    normal: Float32[np.ndarray, "n 3"], direction: Float32[np.ndarray, "n 3"], upright: Float32[np.ndarray, "n 3"]
) -> Float32[np.ndarray, " n"]:
    """Return cosines of incidence: normals and rays in one frame, and the normals where rays have unit length."""
    length = np.sqrt(np.einsum("ni,ni->n", upright, upright))
    cos = np.abs(np.einsum("ni,ni->n", normal, direction)) / np.maximum(length, np.float32(1e-30))
    return np.minimum(cos, np.float32(1))
