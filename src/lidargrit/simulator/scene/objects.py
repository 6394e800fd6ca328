"""Objects that stand or move: kept shapes and places in the street → objects of the scene at a time."""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float32, Float64, Int, Int32, Num, Shaped, UInt16

from lidargrit.simulator.mesh import Objects, Shape
from lidargrit.simulator.scene.street_plan import StreetPlan


@dataclass(frozen=True, eq=False)
class Placements:
    """Positions and motion of objects in the street.

    Args:
        u_m: position along the street at time 0.
        v_m: position to the left of the street's axis.
        turn_rad: heading relative to the street's u axis (the v axis for ``across``).
        speed_m_s: speed in metres per second along the object's heading; 0 for objects that stand still.
        across: True for objects that keep to a side street and head along v.
        rise_m: height of the ground above the road's level, such as a pavement's.
    """

    u_m: Float64[np.ndarray, " n"]
    v_m: Float64[np.ndarray, " n"]
    turn_rad: Float64[np.ndarray, " n"]
    speed_m_s: Float64[np.ndarray, " n"]
    across: np.ndarray
    rise_m: Float64[np.ndarray, " n"]

    @classmethod
    def of(
        cls,
        u_m: Num[np.ndarray, " n"],
        v_m: float | Num[np.ndarray, " n"],
        turn_rad: float | Num[np.ndarray, " n"] = 0.0,
        speed_m_s: float | Num[np.ndarray, " n"] = 0.0,
        across: bool = False,
        rise_m: float | Num[np.ndarray, " n"] = 0.0,
    ) -> "Placements":
        """Make placements from arrays, or from numbers that are the same for all."""
        u, v, turn, speed, rise = (np.full(len(u_m), a, np.float64) for a in (u_m, v_m, turn_rad, speed_m_s, rise_m))
        return cls(u, v, turn, speed, np.full(len(u), across), rise)

    @classmethod
    def join(cls, placements: "list[Placements]") -> "Placements":
        """Join several placements into one."""
        return cls(*(np.concatenate([getattr(s, f.name) for s in placements]) for f in fields(cls)))

    def select(self, which: Shaped[np.ndarray, " m"]) -> "Placements":
        """Return some of them, by index or by truth."""
        return Placements(*(getattr(self, f.name)[which] for f in fields(self)))

    def positions_at(self, time_s: float) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """Return the positions in the street, u and v, at a time."""
        way = self.speed_m_s * time_s
        along, aside = way * np.cos(self.turn_rad), way * np.sin(self.turn_rad)
        return self.u_m + np.where(self.across, -aside, along), self.v_m + np.where(self.across, along, aside)

    def __len__(self) -> int:
        return len(self.u_m)


@dataclass(frozen=True, eq=False)
class ObjectBatch:
    """Objects of kept shapes that stand or move.

    Args:
        shapes: shape of each object.
        size: factors by which each is stretched along, across and upwards.
        albedo: brightness of the parts of each object.
        label: classes of the parts of each object.
        instance: number of each object; 0 for what is no single object.
        placements: positions and motion of the objects.
        leans: whether they stand square to the ground, as vehicles do, and not upright, as trees do.
    """

    shapes: tuple[Shape, ...]
    size: Float64[np.ndarray, "n 3"]
    albedo: tuple[Float32[np.ndarray, " _"], ...]
    label: tuple[UInt16[np.ndarray, " _"], ...]
    instance: Int32[np.ndarray, " n"]
    placements: Placements
    leans: bool = False

    @classmethod
    def standing(
        cls,
        shapes: list[Shape],
        size: Float64[np.ndarray, "n 3"],
        albedo: Num[np.ndarray, "n p"],
        label: tuple[int, ...],
        placements: Placements,
    ) -> "ObjectBatch":
        """Make things that are no single objects to a labeller: all upright, with parts of the same classes."""
        bright, classes = np.asarray(albedo, np.float32), np.array(label, np.uint16)
        nobody = np.zeros(len(shapes), np.int32)
        return cls(tuple(shapes), size, tuple(bright), (classes,) * len(shapes), nobody, placements)

    def at(self, plan: StreetPlan, time_s: float = 0.0) -> Objects:
        """Return the objects in the world at a time."""
        s = self.placements
        poses = plan.poses(*s.positions_at(time_s), s.turn_rad, s.across, s.rise_m)
        frame = np.zeros((len(s), 4, 4))
        cos, sin = np.cos(poses.yaw_rad), np.sin(poses.yaw_rad)
        frame[:, 0, 0], frame[:, 0, 1], frame[:, 1, 0], frame[:, 1, 1] = cos, -sin, sin, cos
        frame[:, 2, 2], frame[:, 3, 3] = 1, 1
        if self.leans:
            frame[:, 2, :2] = np.einsum("nk,nkj->nj", poses.slope, frame[:, :2, :2])
        frame[:, :3, :3] *= self.size[:, None]
        frame[:, :3, 3] = poses.xyz_m
        return Objects(self.shapes, frame, self.albedo, self.label, self.instance)

    def split(self) -> "tuple[ObjectBatch, ObjectBatch]":
        """Return those that stand and those that move."""
        moves = self.placements.speed_m_s != 0
        return self.select(np.flatnonzero(~moves)), self.select(np.flatnonzero(moves))

    def select(self, which: Int[np.ndarray, " m"]) -> "ObjectBatch":
        """Return some of them, by index."""
        albedo, label = (tuple(row[at] for at in which) for row in (self.albedo, self.label))
        shapes, placements = tuple(self.shapes[at] for at in which), self.placements.select(which)
        return ObjectBatch(shapes, self.size[which], albedo, label, self.instance[which], placements, self.leans)
