"""Ray casting: triangles and rays → range, triangle and incidence, with Intel's Embree, on the CPU only."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore import EmbreeDevice
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float32, Float64, Int32

from lidargrit.simulator.mesh import Mesh

_MARGIN_RAD = 0.01  # for the width of beams, and for the turn of a car during a revolution
NOTHING = -1  # the triangle of a ray that meets none

_device = EmbreeDevice()  # one for the process; every scene is freed with its tracer


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


class Tracer:
    """Casts rays at one mesh. Embree runs on the CPU only, in the thread that calls.

    Args:
        mesh: triangles that rays can hit.
        reach_m: longest range at which a hit counts.

    Source:
        Wald et al., Embree: A Kernel Framework for Efficient CPU Ray Tracing, SIGGRAPH 2014.
    """

    def __init__(self, mesh: Mesh, reach_m: float = float("inf")) -> None:
        self._reach_m = min(reach_m, 1e30)  # Embree's own infinity is about 1e37
        self._scene = EmbreeScene(_device)
        self._triangles = TriangleMesh(self._scene, mesh.triangles_m)

    def cast(self, origins_m: Float32[np.ndarray, "n 3"], directions: Float32[np.ndarray, "n 3"]) -> Hits:
        """Find the first hit of every ray.

        Args:
            directions: unit direction vectors of the rays.
        """
        if len(directions) == 0:
            return Hits(np.empty(0, np.float32), np.empty(0, np.int32), np.empty(0, np.float32))
        found = self._scene.run(origins_m, directions, self._reach_m, output=True)
        triangle: np.ndarray = found["primID"]
        missed = triangle < 0
        range_m: np.ndarray = found["tfar"]
        range_m[missed] = np.inf
        normal: np.ndarray = found["Ng"]
        length = np.sqrt(np.einsum("ni,ni->n", normal, normal))
        cos = np.abs(np.einsum("ni,ni->n", normal, directions)) / np.maximum(length, np.float32(1e-30))
        cos[missed] = 0  # the normal is not written there
        return Hits(range_m, triangle, np.minimum(cos, np.float32(1)))

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
            behind = self.cast(origins_m[on] + directions[on] * skin[:, None], directions[on])
            near = skin + behind.range_m <= self._reach_m
            range_m[on] = np.where(near, skin + behind.range_m, np.float32(np.inf))
            triangle[on] = np.where(near, behind.triangle, NOTHING)
            cos[on] = np.where(near, behind.cos_incidence, 0)
        return Hits(range_m, triangle, cos), light
