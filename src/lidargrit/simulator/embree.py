"""Intel's Embree: triangles and rays → the first triangle that each ray meets, on the CPU only."""

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore import EmbreeDevice
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float32, Int32

_device = EmbreeDevice()  # one for the process; every scene is freed with its triangles


class EmbreeTriangles:
    """Triangles in Embree's tree, which is built when the first ray is cast.

    Args:
        triangles_m: corners of the triangles; both sides are met.

    Source:
        Wald et al., Embree: A Kernel Framework for Efficient CPU Ray Tracing, SIGGRAPH 2014.
    """

    def __init__(self, triangles_m: Float32[np.ndarray, "t 3 3"]) -> None:
        self._scene = EmbreeScene(_device)
        self._triangles = TriangleMesh(self._scene, triangles_m)

    def cast(
        self,
        origins_m: Float32[np.ndarray, "n 3"],
        directions: Float32[np.ndarray, "n 3"],
        within: float | Float32[np.ndarray, " n"],
    ) -> tuple[Float32[np.ndarray, " n"], Int32[np.ndarray, " n"], Float32[np.ndarray, "n 3"]]:
        """Return how far the first triangle of each ray lies, its index, and its normal of any length.

        Args:
            directions: vectors of the rays; one that is not of unit length measures distances in its own length.
            within: longest distance of interest. A ray that meets nothing until then has the index -1, and no normal.
        """
        found = self._scene.run(origins_m, directions, within, output=True)
        return found["tfar"], found["primID"], found["Ng"]
