"""Objects that stand or move: shapes in their own frames, and poses → triangles at a time."""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float32, Float64, Int32, Num, Shaped, UInt8, UInt16

from lidargrit.simulator.scene.shapes import MeshBuilder
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
    """Objects of one topology, each with x ahead and its foot at the origin.

    Args:
        local_m: triangles of each object in its own frame.
        material: material index of each triangle.
        albedo: albedo of each triangle.
        label: class of each triangle.
        instance: instance number of each object.
        placements: positions and motion of the objects.
    """

    local_m: Float32[np.ndarray, "n t 3 3"]
    material: UInt8[np.ndarray, "n t"]
    albedo: Float32[np.ndarray, "n t"]
    label: UInt16[np.ndarray, "n t"]
    instance: Int32[np.ndarray, " n"]
    placements: Placements

    def add_to(self, builder: MeshBuilder, plan: StreetPlan, time_s: float = 0.0) -> None:
        """Add the objects to a mesh at their positions at a time."""
        if not len(self.placements):
            return
        s = self.placements
        poses = plan.poses(*s.positions_at(time_s), s.turn_rad, s.across, s.rise_m)
        local = poses.to_world(self.local_m, lean=True)
        builder.add(local, self.material, self.albedo, self.label, self.instance[:, None])

    def split(self) -> "tuple[ObjectBatch, ObjectBatch]":
        """Return those that stand and those that move."""
        moves = self.placements.speed_m_s != 0
        return self._select(np.flatnonzero(~moves)), self._select(np.flatnonzero(moves))

    def _select(self, which: np.ndarray) -> "ObjectBatch":
        arrays = (self.local_m, self.material, self.albedo, self.label, self.instance)
        local, material, albedo, label, instance = (a[which] for a in arrays)
        return ObjectBatch(local, material, albedo, label, instance, self.placements.select(which))
