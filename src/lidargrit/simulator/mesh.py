"""Meshes of a scene: triangles, each with a material, a brightness, a class and an instance."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float, Float32, Int32, UInt8, UInt16


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in metres; z is up.

    Args:
        triangles_m: corners of each triangle; both sides reflect a beam.
        material: index into ``MATERIALS``.
        albedo: share of light that is scattered evenly, 0 to 1, at the wavelength of the sensor.
        label: class number of SemanticKITTI.
        instance: number of the object, unique within a scene; 0 for what is no single object.
    """

    triangles_m: Float32[np.ndarray, "t 3 3"]
    material: UInt8[np.ndarray, " t"]
    albedo: Float32[np.ndarray, " t"]
    label: UInt16[np.ndarray, " t"]
    instance: Int32[np.ndarray, " t"]

    def __len__(self) -> int:
        return len(self.triangles_m)

    @classmethod
    def of(
        cls, triangles_m: Float[np.ndarray, "t 3 3"], material: int, albedo: float, label: int, instance: int = 0
    ) -> "Mesh":
        """Make a mesh of one material, brightness, class and instance."""
        count = len(triangles_m)
        return cls(
            np.asarray(triangles_m, np.float32),
            np.full(count, material, np.uint8),
            np.full(count, albedo, np.float32),
            np.full(count, label, np.uint16),
            np.full(count, instance, np.int32),
        )

    @classmethod
    def join(cls, meshes: "Sequence[Mesh]") -> "Mesh":
        """Make one mesh of several, in their order."""
        return cls(*(np.concatenate([getattr(mesh, field.name) for mesh in meshes]) for field in fields(cls)))

    def moved(self, x_m: float, y_m: float, z_m: float = 0.0, yaw_rad: float = 0.0) -> "Mesh":
        """Return the mesh turned about the z axis, counter-clockwise seen from above, then shifted."""
        cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
        turn = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        shifted = self.triangles_m.astype(np.float64) @ turn + np.array([x_m, y_m, z_m])
        return replace(self, triangles_m=shifted.astype(np.float32))
