"""Meshes of a scene: triangles with what they are made of, and objects whose triangles are kept from scan to scan."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Self

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, Int64, UInt8, UInt16

from lidargrit.simulator.embree import EmbreeTriangles


@dataclass(frozen=True, eq=False)
class Finish:
    """What triangles, or parts of objects, are made of.

    Args:
        material: index into ``MATERIALS``.
        albedo: share of light that is scattered evenly, 0 to 1, at the wavelength of the sensor.
        label: class number of SemanticKITTI.
        instance: number of the object, unique within a scene; 0 for what is no single object.
    """

    material: UInt8[np.ndarray, " t"]
    albedo: Float32[np.ndarray, " t"]
    label: UInt16[np.ndarray, " t"]
    instance: Int32[np.ndarray, " t"]

    def __len__(self) -> int:
        return len(self.material)

    @classmethod
    def join(cls, finishes: Sequence[Self]) -> Self:
        """Join several into one, in their order."""
        return cls(*(np.concatenate([getattr(one, field.name) for one in finishes]) for field in fields(cls)))


@dataclass(frozen=True, eq=False)
class Mesh(Finish):
    """Triangles in metres; z is up.

    Args:
        triangles_m: corners of each triangle; both sides reflect a beam.
    """

    triangles_m: Float32[np.ndarray, "t 3 3"]

    @cached_property
    def kept(self) -> EmbreeTriangles:
        """The triangles in Embree's tree, which stays as long as the mesh."""
        return EmbreeTriangles(self.triangles_m)

    @classmethod
    def of(
        cls, triangles_m: Float[np.ndarray, "t 3 3"], material: int, albedo: float, label: int, instance: int = 0
    ) -> "Mesh":
        """Make a mesh of one material, brightness, class and instance."""
        count = len(triangles_m)
        return cls(
            np.full(count, material, np.uint8),
            np.full(count, albedo, np.float32),
            np.full(count, label, np.uint16),
            np.full(count, instance, np.int32),
            np.asarray(triangles_m, np.float32),
        )


@dataclass(frozen=True, eq=False)
class Shape:
    """Shape of an object in its own frame: made once a process, with an Embree scene that is kept.

    Args:
        triangles_m: corners; x points ahead, z up, and the foot is the origin.
        part: index of the object's part to which each triangle belongs; every object has its own colour of each.
        material: material of each part.
    """

    triangles_m: Float32[np.ndarray, "t 3 3"]
    part: UInt8[np.ndarray, " t"]
    material: UInt8[np.ndarray, " p"]

    def __len__(self) -> int:
        return len(self.triangles_m)

    @cached_property
    def kept(self) -> EmbreeTriangles:
        """The triangles in Embree's tree, which stays as long as the shape."""
        return EmbreeTriangles(self.triangles_m)

    @cached_property
    def box_m(self) -> Float64[np.ndarray, "2 3"]:
        """Lowest and highest coordinates."""
        corners = self.triangles_m.reshape(-1, 3).astype(np.float64)
        return np.stack((corners.min(axis=0), corners.max(axis=0)))


@dataclass(frozen=True, eq=False)
class Objects:
    """Objects of a scene, each a kept shape at a place.

    Args:
        shapes: the shape of each object.
        frame: transform from each object's frame to the scene's; it may stretch and shear.
        albedo: brightness of the parts of each object.
        label: classes of the parts of each object.
        instance: number of each object; 0 for what is no single object.
    """

    shapes: tuple[Shape, ...]
    frame: Float64[np.ndarray, "n 4 4"]
    albedo: tuple[Float32[np.ndarray, " _"], ...]
    label: tuple[UInt16[np.ndarray, " _"], ...]
    instance: Int32[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.shapes)

    @classmethod
    def none(cls) -> "Objects":
        """Return no object at all."""
        return cls((), np.zeros((0, 4, 4)), (), (), np.zeros(0, np.int32))

    @classmethod
    def join(cls, objects: "Sequence[Objects]") -> "Objects":
        """Join several collections of objects into one."""
        return cls(
            tuple(shape for some in objects for shape in some.shapes),
            np.concatenate([np.zeros((0, 4, 4)), *(some.frame for some in objects)]),
            tuple(albedo for some in objects for albedo in some.albedo),
            tuple(label for some in objects for label in some.label),
            np.concatenate([np.zeros(0, np.int32), *(some.instance for some in objects)]),
        )

    def select(self, which: Bool[np.ndarray, " n"]) -> "Objects":
        """Return some of them."""
        some = np.flatnonzero(which)
        albedo, label = (tuple(row[at] for at in some) for row in (self.albedo, self.label))
        return Objects(tuple(self.shapes[at] for at in some), self.frame[some], albedo, label, self.instance[some])

    def first_part(self) -> Int64[np.ndarray, " n"]:
        """Return how many parts the objects before each have."""
        return np.cumsum([0, *(len(shape.material) for shape in self.shapes)])[:-1]

    def finish(self) -> Finish:
        """Return what their parts are made of, object after object."""
        if not self.shapes:
            return Mesh.of(np.zeros((0, 3, 3)), 0, 0.0, 0)
        material = [shape.material for shape in self.shapes]
        instance = np.repeat(self.instance, [len(parts) for parts in material])
        return Finish(np.concatenate(material), np.concatenate(self.albedo), np.concatenate(self.label), instance)
