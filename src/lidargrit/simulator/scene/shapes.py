"""Simple solids, many at once: arrays of sizes → arrays of triangles; a builder of them → a mesh."""

import numpy as np
from jaxtyping import Float, Float32, Float64, Int, Num
from numpy.typing import ArrayLike

from lidargrit.simulator.mesh import Mesh, Shape

# Corners of a box are numbered 4 x + 2 y + z, with 1 for the high side.
_BOX_FACES = np.array(
    [
        *((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5)),
        *((0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6)),
        *((0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)),
    ]
)
_BOX_CORNERS = np.array([(i >> 2 & 1, i >> 1 & 1, i & 1) for i in range(8)], np.float32)


class MeshBuilder:
    """Collects triangles with what they are made of, and joins them once at the end."""

    def __init__(self) -> None:
        self._parts: list[tuple[np.ndarray, ...]] = []

    def add(
        self,
        triangles_m: Num[np.ndarray, "*lead 3 3"],
        material: int | Num[np.ndarray, "..."],
        albedo: float | Num[np.ndarray, "..."],
        label: int | Num[np.ndarray, "..."],
        instance: int | Num[np.ndarray, "..."] = 0,
    ) -> None:
        """Add triangles; the rest is broadcast to the axes before their corners."""
        lead = triangles_m.shape[:-2]
        if 0 in lead:
            return
        flat = []
        for value, kind in ((material, np.uint8), (albedo, np.float32), (label, np.uint16), (instance, np.int32)):
            column = np.empty(lead, kind)
            column[...] = value
            flat.append(column.reshape(-1))
        self._parts.append((np.asarray(triangles_m, np.float32).reshape(-1, 3, 3), *flat))

    def __len__(self) -> int:
        return sum(len(part[0]) for part in self._parts)

    def build(self) -> Mesh:
        """Return all that was added, in order."""
        if not self._parts:
            return Mesh.of(np.zeros((0, 3, 3)), 0, 0.0, 0)
        triangles_m, material, albedo, label, instance = (np.concatenate(c) for c in zip(*self._parts, strict=True))
        return Mesh(material, albedo, label, instance, triangles_m)


class ShapeBuilder:
    """Collects the parts of one shape, each of one material.

    Args:
        materials: material of each part.
    """

    def __init__(self, *materials: int) -> None:
        self._materials = np.array(materials, np.uint8)
        self._triangles: list[np.ndarray] = []
        self._parts: list[np.ndarray] = []

    def add(self, part: int, triangles_m: Num[np.ndarray, "*lead 3 3"]) -> None:
        """Add triangles to a part."""
        flat = np.asarray(triangles_m, np.float32).reshape(-1, 3, 3)
        self._triangles.append(flat)
        self._parts.append(np.full(len(flat), part, np.uint8))

    def add_box(self, part: int, low_m: ArrayLike, high_m: ArrayLike) -> None:
        """Add an upright box between its low and its high corner to a part."""
        self.add(part, boxes(np.array(low_m), np.array(high_m)))

    def build(self) -> Shape:
        """Return the shape; triangles without area are left out."""
        triangles, parts = np.concatenate(self._triangles), np.concatenate(self._parts)
        normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        has_area = np.linalg.norm(normal, axis=1) > 1e-7
        return Shape(triangles[has_area], parts[has_area], self._materials)


def boxes(low_m: Num[np.ndarray, "*lead 3"], high_m: Num[np.ndarray, "*lead 3"]) -> Float32[np.ndarray, "*lead 12 3 3"]:
    """Return upright boxes between their low and their high corners."""
    low, high = np.asarray(low_m, np.float32), np.asarray(high_m, np.float32)
    corners = low[..., None, :] + (high - low)[..., None, :] * _BOX_CORNERS
    return corners[..., _BOX_FACES, :]


def blocks(corners_m: Num[np.ndarray, "n 8 3"]) -> Float32[np.ndarray, "n 12 3 3"]:
    """Return bent boxes of eight corners each, in the order x low to high, in it y, in it z."""
    return np.asarray(corners_m, np.float32)[:, _BOX_FACES]


def quads(corners_m: Num[np.ndarray, "*lead 4 3"]) -> Float32[np.ndarray, "*lead 2 3 3"]:
    """Return two triangles for each four corners that go round."""
    return np.asarray(corners_m, np.float32)[..., [[0, 1, 2], [0, 2, 3]], :]


def sweep(
    path_m: Num[np.ndarray, "k 3"], radius_m: Num[np.ndarray, " k"], sides: int = 8
) -> Float32[np.ndarray, "t 3 3"]:
    """Return a round body along a path of points, of a radius at each, closed by its first and last ring."""
    path, radius = np.asarray(path_m, np.float64), np.asarray(radius_m, np.float64)
    way = np.gradient(path, axis=0)
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
    helper = np.array([0.0, 0.0, 1.0]) if abs(way[:, 2]).mean() < 0.8 else np.array([1.0, 0.0, 0.0])
    across = np.cross(way, helper)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    up = np.cross(way, across)
    turn = 2 * np.pi / sides * np.arange(sides)
    ring = np.cos(turn)[:, None] * across[:, None] + np.sin(turn)[:, None] * up[:, None]
    rings = path[:, None] + ring * radius[:, None, None]
    return np.concatenate((loft(rings[None]).reshape(-1, 3, 3), fans(rings[[0, -1]]).reshape(-1, 3, 3)))


def lathe(
    radius_m: Num[np.ndarray, " k"], height_m: Num[np.ndarray, " k"], sides: int = 16
) -> Float32[np.ndarray, "t 3 3"]:
    """Return a body turned about the z axis: a radius at each height, in the order of the outline."""
    turn = 2 * np.pi / sides * np.arange(sides)
    radius, height = (np.asarray(a, np.float64)[:, None] for a in (radius_m, height_m))
    rings = np.stack((radius * np.cos(turn), radius * np.sin(turn), height + 0 * turn), axis=-1)
    return loft(rings[None]).reshape(-1, 3, 3)


def loft(rings_m: Num[np.ndarray, "n s r 3"]) -> Float32[np.ndarray, "n s-1 r 2 3 3"]:
    """Return the skin over closed rings of points, two triangles between neighbours of neighbouring rings."""
    rings = np.asarray(rings_m, np.float32)
    following = np.roll(rings, -1, axis=2)
    near, near_next, far, far_next = rings[:, :-1], following[:, :-1], rings[:, 1:], following[:, 1:]
    first, second = np.stack((near, near_next, far_next), axis=3), np.stack((near, far_next, far), axis=3)
    return np.stack((first, second), axis=3)


def fans(rim_m: Num[np.ndarray, "*lead r 3"]) -> Float32[np.ndarray, "*lead r-2 3 3"]:
    """Return a flat cap over each rim."""
    rim = np.asarray(rim_m, np.float32)
    first = np.broadcast_to(rim[..., :1, :], rim[..., 2:, :].shape)
    return np.stack((first, rim[..., 1:-1, :], rim[..., 2:, :]), axis=-2)


def _turned_triangles(count: int = 512) -> np.ndarray:
    """Return unit triangles whose normals are spread evenly over the half sphere (a golden spiral)."""
    index = np.arange(count)
    height, turn = (index + 0.5) / count, index * np.pi * (3 - 5**0.5)
    flat = np.sqrt(1 - height**2)
    normal = np.stack((flat * np.cos(turn), flat * np.sin(turn), height), axis=1)
    across = np.cross(normal, [[0.6, 0.48, 0.64]])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    up = np.cross(normal, across)
    spin = index[:, None, None] * 2.4 + np.arange(3)[:, None] * 2 * np.pi / 3  # (count, 3 corners, 1)
    stretch = 1 + 0.35 * np.sin(index * 1.7)[:, None, None]
    corners = stretch * np.cos(spin) * across[:, None] + np.sin(spin) * up[:, None] / stretch
    shuffled = np.argsort((index * 0.6180339887) % 1)  # neighbours in the table face different ways
    return corners[shuffled].astype(np.float32)


_LEAF = _turned_triangles()


def leaves(
    centre_m: Float[np.ndarray, "n 3"], radius_m: float | Float[np.ndarray, " n"]
) -> Float32[np.ndarray, "n 3 3"]:
    """Return one triangle a leaf (or a tuft of them), turned every way; its corners lie about a radius away."""
    size = np.broadcast_to(np.float32(radius_m), len(centre_m))
    turned = np.resize(_LEAF, (len(centre_m), 3, 3))
    turned *= size[:, None, None]
    turned += np.asarray(centre_m, np.float32)[:, None]
    return turned


def owners(counts: Int[np.ndarray, " n"]) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Return 0 counts[0] times, 1 counts[1] times, and so on; and 0, 1, 2, ... for each of them."""
    owner = np.repeat(np.arange(len(counts)), counts)
    return owner, np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)


def rows_of(*columns: int | float | Num[np.ndarray, " n"]) -> Float64[np.ndarray, "n c"]:
    """Return columns, or numbers for whole columns, side by side."""
    rows = np.empty((next(len(c) for c in columns if isinstance(c, np.ndarray)), len(columns)))
    for at, column in enumerate(columns):
        rows[:, at] = column
    return rows
