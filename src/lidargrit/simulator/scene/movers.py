"""Things that stand or move on their own: shapes in their own frames and where they are → triangles at a time."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float32, Float64, Int32, Num, Shaped, UInt8, UInt16

from lidargrit.simulator.scene.plan import Plan
from lidargrit.simulator.scene.shapes import Pile


@dataclass(frozen=True, eq=False)
class Stands:
    """Where things are in the street, and how they move.

    Args:
        u_m: along the street at time 0.
        v_m: to its left.
        turn_rad: heading against the street's u axis (or v axis, for ``across``).
        speed_m_s: along its own heading; 0 for what stands.
        across: whether it keeps to a side street, and heads along v.
        rise_m: how high the ground is over the road's level (pavements).
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
    ) -> Stands:
        """Make stands of arrays, or of numbers that hold for all."""
        u, v, turn, speed, rise = (np.full(len(u_m), a, np.float64) for a in (u_m, v_m, turn_rad, speed_m_s, rise_m))
        return cls(u, v, turn, speed, np.full(len(u), across), rise)

    @classmethod
    def join(cls, stands: list[Stands]) -> Stands:
        """Return all of several."""
        return cls(*(np.concatenate([getattr(s, f.name) for s in stands]) for f in fields(cls)))

    def those(self, which: Shaped[np.ndarray, " m"]) -> Stands:
        """Return some of them, by index or by truth."""
        return Stands(*(getattr(self, f.name)[which] for f in fields(self)))

    def after(self, time_s: float) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """Return where they are in the street, u and v, at a time."""
        way = self.speed_m_s * time_s
        along, aside = way * np.cos(self.turn_rad), way * np.sin(self.turn_rad)
        return self.u_m + np.where(self.across, -aside, along), self.v_m + np.where(self.across, along, aside)

    def __len__(self) -> int:
        return len(self.u_m)


@dataclass(frozen=True, eq=False)
class Herd:
    """Things of one topology, each with x ahead and its foot at the origin.

    Args:
        local_m: their triangles.
        material: of every triangle.
        albedo: of every triangle.
        label: of every triangle.
        instance: of every thing.
        stands: where they are.
    """

    local_m: Float32[np.ndarray, "n t 3 3"]
    material: UInt8[np.ndarray, "n t"]
    albedo: Float32[np.ndarray, "n t"]
    label: UInt16[np.ndarray, "n t"]
    instance: Int32[np.ndarray, " n"]
    stands: Stands

    def add_to(self, pile: Pile, plan: Plan, time_s: float = 0.0) -> None:
        """Add the things where they are at a time."""
        if not len(self.stands):
            return
        s = self.stands
        poses = plan.poses(*s.after(time_s), s.turn_rad, s.across, s.rise_m)
        local = poses.put(self.local_m, lean=True)
        pile.add(local, self.material, self.albedo, self.label, self.instance[:, None])

    def split(self) -> tuple[Herd, Herd]:
        """Return those that stand and those that move."""
        moves = self.stands.speed_m_s != 0
        return self._those(np.flatnonzero(~moves)), self._those(np.flatnonzero(moves))

    def _those(self, which: np.ndarray) -> Herd:
        arrays = (self.local_m, self.material, self.albedo, self.label, self.instance)
        local, material, albedo, label, instance = (a[which] for a in arrays)
        return Herd(local, material, albedo, label, instance, self.stands.those(which))
