"""Plan of a street: random numbers → roads, heights of the ground, and the map from street coordinates to the world.

Everything is laid out in street coordinates: u runs along our road, v to its left, both in metres. Roads and houses are
upright rectangles there; one smooth map bends them into the world.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Num, Shaped

from lidargrit.simulator.scene.shapes import blocks
from lidargrit.simulator.scene.stretches import EXTENT_M, LENGTH_M, Stretch

Theme = Literal["city", "suburb", "country", "mixed"]
PARKING_M = 2.1  # width of a parked row
_COURT_FROM_M = 11.0  # from the pavement to the houses
_LOOKS_FOR_S = 2.0  # how long a street keeps its full detail around our car
_VIEWPOINT_SPACING_M = 6.0  # at most, along our car's way
_SKEW_REACH_M, _SKEW_WIDTH_M = 25.0, 25.0  # how far from our road, and from its mouth, a side street runs askew


@dataclass(frozen=True, eq=False)
class SideStreet:
    """A street that leaves ours at ``u_m``; its own v axis is ours, and it ends ``end_m`` from the middle of ours."""

    u_m: float
    half_m: float
    pavement_m: float
    sides: tuple[int, ...]
    skew: float
    end_m: float = np.inf


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of objects: foot points, headings and the slope of the ground there."""

    xyz_m: Float[np.ndarray, "n 3"]
    yaw_rad: Float[np.ndarray, " n"]
    slope: Float[np.ndarray, "n 2"]

    def to_world(self, local_m: Float32[np.ndarray, "n *shape 3"]) -> Float32[np.ndarray, "n *shape 3"]:
        """Move things from their own frames into the world."""
        spread = (slice(None),) + (None,) * (local_m.ndim - 2)
        cos, sin = (f(self.yaw_rad).astype(np.float32)[spread] for f in (np.cos, np.sin))
        foot = self.xyz_m.astype(np.float32)
        out = np.empty_like(local_m)
        x = cos * local_m[..., 0] - sin * local_m[..., 1]
        y = sin * local_m[..., 0] + cos * local_m[..., 1]
        np.add(x, foot[:, 0][spread], out=out[..., 0])
        np.add(y, foot[:, 1][spread], out=out[..., 1])
        np.add(local_m[..., 2], foot[:, 2][spread], out=out[..., 2])
        return out

    def of(self, which: Shaped[np.ndarray, " m"]) -> "Poses":
        """Return the poses of some, or of some several times over."""
        return Poses(self.xyz_m[which], self.yaw_rad[which], self.slope[which])


@dataclass(frozen=True, eq=False)
class Place:
    """Place of a further stretch in the world of its drive, whose own world is that one, moved and not turned.

    Args:
        heading_rad: heading of the drive's world in the frame of the line.
        foot_m: height of the ground below our wheels where the drive begins.
        offset_m: place in the drive's world at which the stretch's own begins.
    """

    heading_rad: float
    foot_m: float
    offset_m: Float[np.ndarray, "3"]


@dataclass(frozen=True, eq=False)
class StreetPlan:
    """Plan of one stretch of a street, in street coordinates.

    Args:
        theme: kind of street: city, suburb or country.
        lanes: 1 if cars of both ways share the carriageway, otherwise 2.
        lane_m: width of a lane.
        edge_m: distances from the middle of the carriageway to the kerbs, right and left, both positive.
        parked: whether cars park along the kerb, right and left.
        pavement_m: widths of the pavements, right and left.
        setback_m: distances from the pavement to the houses, right and left.
        our_v_m: v of the lane in which our own car drives.
        side_streets: streets that leave our road.
        bridge_u_m: u at which another road crosses above ours; infinite for no bridge.
        line: knots of the middle of our road: u, x, y, cosine and sine of its heading, in a frame that begins at u = 0.
        waves: amplitude, wave vector (2) and phase of every wave of the ground.
        tilt: slope of the whole ground along x and y.
        camber: fall of the road from its middle to its edges.
        banks_m: rise of the ground beside the road, right and left.
        level_m: heights of pavements and of gardens or fields above the road.
        speed_m_s: speed of our own car.
        ends_m: u at which our road ends at houses across, behind us and ahead; infinite for a road that goes on.
        stretch: kind of this stretch of the road.
        neighbours: side streets of the stretches beside this one, which bend it a little.
        place: place of a further stretch; the first one's world is the drive's.
        viewpoints_m: positions of our car in the first seconds, or all along the rest of the road, in world
            coordinates; fine detail is made near them.
    """

    theme: str
    lanes: int
    lane_m: float
    edge_m: tuple[float, float]
    parked: tuple[bool, bool]
    pavement_m: tuple[float, float]
    setback_m: tuple[float, float]
    our_v_m: float
    side_streets: tuple[SideStreet, ...]
    bridge_u_m: float
    line: Float[np.ndarray, "k 5"]
    waves: Float[np.ndarray, "w 4"]
    tilt: Float[np.ndarray, "2"]
    camber: float
    banks_m: tuple[float, float]
    level_m: tuple[float, float]
    speed_m_s: float
    ends_m: tuple[float, float] = (-np.inf, np.inf)
    stretch: Stretch = Stretch.FIRST
    neighbours: tuple[SideStreet, ...] = ()
    place: Place | None = None
    viewpoints_m: Float[np.ndarray, "k 2"] = field(init=False, repr=False)
    _origin: tuple[np.ndarray, float, float] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.place:
            foot_m = self.place.foot_m + float(self.place.offset_m[2])
            object.__setattr__(self, "_origin", (np.zeros(2), self.place.heading_rad, foot_m))
        else:
            here, ahead = self._bent(np.array([0.0, 1.0]), np.full(2, self.our_v_m))
            heading = np.arctan2(*(ahead - here)[::-1])
            object.__setattr__(self, "_origin", (here, float(heading), 0.0))
            foot_m = float(self.ground_points(np.zeros(1), np.array([self.our_v_m]))[0, 2])
            object.__setattr__(self, "_origin", (here, float(heading), foot_m))
        start, way = {
            Stretch.FIRST: (0.0, self.speed_m_s * _LOOKS_FOR_S),
            Stretch.REST: (0.0, EXTENT_M),
            Stretch.FURTHER: (-LENGTH_M / 2, LENGTH_M),
        }[self.stretch]
        u = np.linspace(start, start + way, 1 + int(np.ceil(way / _VIEWPOINT_SPACING_M)))
        object.__setattr__(self, "viewpoints_m", self._flat(u, np.full(len(u), self.our_v_m)))

    @property
    def offset_m(self) -> Float[np.ndarray, "3"]:
        """Where the world of this stretch begins in that of its drive."""
        return self.place.offset_m if self.place else np.zeros(3)

    @property
    def own_streets(self) -> tuple[SideStreet, ...]:
        """Side streets beside which things are still to be laid out."""
        return () if self.stretch is Stretch.REST else self.side_streets

    def goes_on(self, u_m: Num[np.ndarray, "*s"]) -> Bool[np.ndarray, "*s"]:
        """Return at which positions our road has not ended yet."""
        return (np.asarray(u_m) > self.ends_m[0]) & (np.asarray(u_m) < self.ends_m[1])

    def nearest_approach_m(self, points_m: Num[np.ndarray, "n _"]) -> Float[np.ndarray, " n"]:
        """Return the smallest distance of our car from points, the same for all frames; see ``viewpoints_m``."""
        apart = points_m[:, :2] - self.viewpoints_m[:, None]
        return np.sqrt((apart[..., 0] ** 2 + apart[..., 1] ** 2).min(axis=0))

    def edge(self, side: int) -> float:
        """Return the v of the kerb on the left (side 1) or on the right (-1)."""
        return side * self.edge_m[(side + 1) // 2]

    def front(self, side: int) -> float:
        """Return the v of the line of houses."""
        which = (side + 1) // 2
        return side * (self.edge_m[which] + self.pavement_m[which] + self.setback_m[which])

    def outer_lanes(self, side: int) -> int:
        """Return how many lanes there are beside the inner ones on the left (side 1) or on the right (-1)."""
        which = (side + 1) // 2
        room_m = self.edge_m[which] - self.lane_m * self.lanes / 2 - PARKING_M * self.parked[which]
        return max(int(room_m / self.lane_m), 0)

    def court_m(self, side: int) -> float:
        """Return the depth of the place for parked cars before houses that stand far back; 0 for none."""
        setback_m = self.setback_m[(side + 1) // 2]
        return min(setback_m - 4.0, 17.0) if setback_m > _COURT_FROM_M and self.theme != "country" else 0.0

    @property
    def farthest_front_m(self) -> float:
        """Distance from the middle of the road to the farther line of houses."""
        return max(self.front(1), -self.front(-1))

    def ground_points(self, u_m: Num[np.ndarray, "*s"], v_m: Num[np.ndarray, "*s"]) -> Float[np.ndarray, "*s 3"]:
        """Return the points of the ground, at the level of the road, at positions in the street."""
        flat = self._flat(u_m, v_m)
        return np.concatenate((flat, self._height(flat, u_m, v_m)[..., None]), axis=-1)

    def poses(
        self,
        u_m: Num[np.ndarray, " n"],
        v_m: Num[np.ndarray, " n"],
        turn_rad: float | Num[np.ndarray, " n"] = 0.0,
        across: bool | Bool[np.ndarray, " n"] = False,
        rise_m: float | Num[np.ndarray, " n"] = 0.0,
    ) -> Poses:
        """Return poses of things that head along the street, or along side streets (``across``), turned and raised."""
        u, v = np.asarray(u_m, np.float64), np.asarray(v_m, np.float64)
        step_u, step_v = np.where(across, 0.0, 0.5), np.where(across, 0.5, 0.0)
        flat, before, behind = self._flat(np.stack((u, u + step_u, u - step_u)), np.stack((v, v + step_v, v - step_v)))
        ahead = before - behind
        foot = np.concatenate((flat, (self._height(flat, u, v) + rise_m)[:, None]), axis=1)
        around = foot[:, None, :2] + np.array([(0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)])
        high = self._ground(around)
        slope = np.stack((high[:, 0] - high[:, 1], high[:, 2] - high[:, 3]), axis=-1)
        return Poses(foot, np.arctan2(ahead[:, 1], ahead[:, 0]) + turn_rad, slope)

    def blocks(
        self,
        u_from_m: float | Num[np.ndarray, " n"],
        u_to_m: float | Num[np.ndarray, " n"],
        v_from_m: float | Num[np.ndarray, " n"],
        v_to_m: float | Num[np.ndarray, " n"],
        bottom_m: float | Num[np.ndarray, " n"],
        top_m: float | Num[np.ndarray, " n"],
        flare_m: float = 0.0,
    ) -> Float32[np.ndarray, "n 12 3 3"]:
        """Return boxes of the street, bent as the street is; heights are over the road's level at each corner.

        Slopes at their u ends run out at the bottom by ``flare_m``.
        """
        spans = (u_from_m, u_to_m, v_from_m, v_to_m, bottom_m, top_m)
        u_0, u_1, v_0, v_1, z_0, z_1 = np.broadcast_arrays(*(np.atleast_1d(s) for s in spans))
        u = np.stack((u_0 - flare_m, u_0, u_0 - flare_m, u_0, u_1 + flare_m, u_1, u_1 + flare_m, u_1), axis=1)
        v = np.stack((v_0, v_0, v_1, v_1, v_0, v_0, v_1, v_1), axis=1)
        corners = self.ground_points(u, v)
        corners[..., 2] += np.stack((z_0, z_1) * 4, axis=1)
        return blocks(corners)

    def in_side_street(
        self, u_m: Num[np.ndarray, "*s"], v_m: Num[np.ndarray, "*s"], spare_m: float | Float[np.ndarray, "*s"] = 0.0
    ) -> Float[np.ndarray, "*s"]:
        """Return by how many metres points lie inside a side street (negative: outside all)."""
        inside = np.full(np.broadcast_shapes(np.shape(u_m), np.shape(v_m)), -np.inf)
        for street in self.side_streets:
            depth = street.half_m + spare_m - np.abs(np.asarray(u_m) - street.u_m)
            for side in street.sides:
                away = np.asarray(v_m) * side
                inside = np.maximum(inside, np.where((away > 0) & (away < street.end_m + spare_m), depth, -np.inf))
        return inside

    def place_of(self, point_m: Float[np.ndarray, "2"]) -> Place:
        """Return the place of a further stretch whose own world begins at a point, in the frame of the line."""
        here, heading_rad, foot_m = self._origin
        cos, sin = np.cos(heading_rad), np.sin(heading_rad)
        flat = (point_m - here) @ np.array([[cos, -sin], [sin, cos]])
        return Place(heading_rad, foot_m, np.array([*flat, self._ground(flat) - foot_m]))

    def _bent(self, u_m: np.ndarray, v_m: np.ndarray) -> np.ndarray:
        u = np.asarray(u_m, np.float64)
        v = np.asarray(v_m, np.float64)
        for street in (*self.side_streets, *self.neighbours):
            if street.skew:
                reach = _SKEW_REACH_M * np.tanh(v / _SKEW_REACH_M)
                u = u + street.skew * reach * np.exp(-(((np.asarray(u_m) - street.u_m) / _SKEW_WIDTH_M) ** 2))
        knots = self.line
        step = knots[1, 0] - knots[0, 0]
        position = (u - knots[0, 0]) / step
        left = np.clip(position, 0, len(knots) - 1.001).astype(np.intp)  # beyond its ends the line goes straight on
        share = (position - left)[..., None]
        near = knots[left]
        both = near + (knots[left + 1] - near) * share
        tangent = both[..., 3:]
        return both[..., 1:3] + np.stack((-tangent[..., 1], tangent[..., 0]), axis=-1) * v[..., None]

    def _flat(self, u_m: np.ndarray, v_m: np.ndarray) -> np.ndarray:
        here, heading, _ = self._origin
        if np.shape(u_m) != np.shape(v_m):
            u_m, v_m = np.broadcast_arrays(u_m, v_m)
        away = self._bent(u_m, v_m) - here
        cos, sin = np.cos(heading), np.sin(heading)
        return away @ np.array([[cos, -sin], [sin, cos]])

    def _ground(self, flat: np.ndarray) -> np.ndarray:
        if self.place:
            flat = flat + self.place.offset_m[:2]
        phase = flat @ self.waves[:, 1:3].T + self.waves[:, 3]
        return np.sin(phase) @ self.waves[:, 0] + flat @ self.tilt

    def _height(self, flat: np.ndarray, u_m: np.ndarray, v_m: np.ndarray) -> np.ndarray:
        v = np.broadcast_to(np.asarray(v_m, np.float64), flat.shape[:-1])
        height = self._ground(flat) - self._origin[2]
        height = height - self.camber * np.clip(np.abs(v), 0, min(self.edge_m))
        for which, side in enumerate((-1, 1)):
            if self.banks_m[which]:
                beside = np.clip((side * v - self.edge_m[which] - 1.5) / 14.0, 0, 1)
                height = height + self.banks_m[which] * beside**2 * (3 - 2 * beside)
        return height
