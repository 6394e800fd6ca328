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
_PARKING_M = 2.1  # width of a parked row
_PARK_CHANCE = {"city": (0.65, 0.65), "suburb": (0.5, 0.5), "country": (0.0, 0.0)}  # right, left
_LANE_M = {"city": (2.9, 3.7), "suburb": (2.7, 3.4), "country": (2.8, 3.4)}
_PAVEMENT_M = {"city": (2.0, 4.5), "suburb": (1.2, 2.8), "country": (0.0, 0.01)}
_SETBACK_M = {"city": (0.0, 2.5), "suburb": (1.5, 6.5), "country": (5.0, 18.0)}
_SIDE_STREETS = {"city": 2.4, "suburb": 2.4, "country": 0.5}  # how many on average
_WIDE_CHANCE = {"city": 0.15, "suburb": 0.06, "country": 0.0}  # of more lanes, bays across, or a strip in between
_WIDER_M = (2.5, 9.0)
_OPEN_CHANCE = {"city": 0.08, "suburb": 0.05, "country": 0.0}  # of a square: houses far back on one side
_OPEN_M = (10.0, 45.0)
_SPEED_M_S = {"city": (2.0, 11.0), "suburb": (3.0, 11.0), "country": (9.0, 22.0)}
_LOOKS_FOR_S = 2.0  # how long a street keeps its full detail around our car
_VIEWPOINT_SPACING_M = 6.0  # at most, along our car's way
_SKEW_REACH_M, _SKEW_WIDTH_M = 25.0, 25.0  # how far from our road, and from its mouth, a side street runs askew

_FROM_END_M, _SKEW_FROM_END_M = 26.0, 75.0  # side streets, and those askew, to the end of their further stretch


@dataclass(frozen=True, eq=False)
class SideStreet:
    """A street that leaves ours at ``u_m``; its own v axis is ours."""

    u_m: float
    half_m: float
    pavement_m: float
    sides: tuple[int, ...]
    skew: float


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of objects: foot points, headings and the slope of the ground there."""

    xyz_m: Float[np.ndarray, "n 3"]
    yaw_rad: Float[np.ndarray, " n"]
    slope: Float[np.ndarray, "n 2"]

    def to_world(
        self, local_m: Float32[np.ndarray, "n *shape 3"], lean: bool = False
    ) -> Float32[np.ndarray, "n *shape 3"]:
        """Move things from their own frames into the world; what leans follows the slope of the ground."""
        spread = (slice(None),) + (None,) * (local_m.ndim - 2)
        cos, sin = (f(self.yaw_rad).astype(np.float32)[spread] for f in (np.cos, np.sin))
        foot, slope = self.xyz_m.astype(np.float32), self.slope.astype(np.float32)
        out = np.empty_like(local_m)
        x = cos * local_m[..., 0] - sin * local_m[..., 1]
        y = sin * local_m[..., 0] + cos * local_m[..., 1]
        np.add(x, foot[:, 0][spread], out=out[..., 0])
        np.add(y, foot[:, 1][spread], out=out[..., 1])
        np.add(local_m[..., 2], foot[:, 2][spread], out=out[..., 2])
        if lean:
            out[..., 2] += slope[:, 0][spread] * x + slope[:, 1][spread] * y
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
            foot_m = float(self.height_m(np.zeros(1), np.array([self.our_v_m]))[0])
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

    def ground_points(self, u_m: Num[np.ndarray, "*s"], v_m: Num[np.ndarray, "*s"]) -> Float[np.ndarray, "*s 3"]:
        """Return the points of the ground, at the level of the road, at positions in the street."""
        flat = self._flat(u_m, v_m)
        return np.concatenate((flat, self._height(flat, u_m, v_m)[..., None]), axis=-1)

    def height_m(self, u_m: Num[np.ndarray, "*s"], v_m: Num[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
        """Return how high the ground, at the level of the road, is over our own wheels."""
        return self._height(self._flat(u_m, v_m), u_m, v_m)

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
        self, u_m: Num[np.ndarray, "*s"], v_m: Num[np.ndarray, "*s"], spare_m: float = 0.0
    ) -> Float[np.ndarray, "*s"]:
        """Return by how many metres points lie inside a side street (negative: outside all)."""
        inside = np.full(np.broadcast_shapes(np.shape(u_m), np.shape(v_m)), -np.inf)
        for street in self.side_streets:
            depth = street.half_m + spare_m - np.abs(np.asarray(u_m) - street.u_m)
            for side in street.sides:
                inside = np.maximum(inside, np.where(np.asarray(v_m) * side > 0, depth, -np.inf))
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


def sample_street_plan(rng: np.random.Generator, theme: Theme) -> StreetPlan:
    """Sample roads and ground of one theme."""
    kind = str(rng.choice(["suburb", "city", "country"], p=[0.52, 0.38, 0.10])) if theme == "mixed" else theme
    lanes = 2 if kind == "country" or rng.random() < {"city": 0.8, "suburb": 0.5}[kind] else 1
    lane = rng.uniform(*_LANE_M[kind]) * (1.0 if lanes == 2 else rng.uniform(1.25, 1.6))
    parked = rng.random(2) < _PARK_CHANCE[kind]
    edge = lane * lanes / 2 + np.where(parked, _PARKING_M, rng.uniform(0.15, 0.4, 2))
    close = 0.15 if kind == "suburb" and rng.random() < 0.2 else 1.0  # streets without front gardens
    setback = close * rng.uniform(*_SETBACK_M[kind], 2)
    edge += np.where(rng.random(2) < _WIDE_CHANCE[kind], rng.uniform(*_WIDER_M, 2), 0.0)
    setback += np.where(rng.random(2) < _OPEN_CHANCE[kind], rng.uniform(*_OPEN_M, 2), 0.0)
    pavement = rng.uniform(*_PAVEMENT_M[kind], 2)
    streets = _sample_side_streets(rng, kind)
    bridge = sample_bridge(rng, streets)
    wild = kind == "country"
    return StreetPlan(
        theme=kind,
        lanes=lanes,
        lane_m=lane,
        edge_m=(float(edge[0]), float(edge[1])),
        parked=(bool(parked[0]), bool(parked[1])),
        pavement_m=(float(pavement[0]), float(pavement[1])),
        setback_m=(float(setback[0]), float(setback[1])),
        our_v_m=-lane / 2 * rng.uniform(0.7, 1.02) if lanes == 2 else rng.uniform(-0.2, 0.2),
        side_streets=streets,
        bridge_u_m=bridge,
        line=_sample_line(rng, kind),
        waves=_sample_waves(rng),
        tilt=rng.normal(0, 0.016, 2),
        camber=rng.uniform(0.005, 0.035),
        banks_m=(rng.normal(0.2, 1.0), rng.normal(0.2, 1.0)) if wild else (0.0, 0.0),
        level_m=(0.0, -0.03) if wild else (rng.uniform(0.06, 0.15), rng.uniform(0.1, 0.25)),
        speed_m_s=0.0 if rng.random() < 0.15 else float(rng.uniform(*_SPEED_M_S[kind])),
    )


def sample_bridge(rng: np.random.Generator, streets: tuple[SideStreet, ...], to_m: float = 70.0) -> float:
    """Sample where another road crosses above ours, within a distance and clear of side streets; mostly nowhere."""
    bridge = rng.uniform(14, to_m) * rng.choice([-1, 1]) if rng.random() < 0.06 else np.inf
    return np.inf if any(abs(street.u_m - bridge) < 22 for street in streets) else float(bridge)


def sample_further_streets(rng: np.random.Generator, kind: str) -> tuple[SideStreet, ...]:
    """Sample the side streets of a further stretch; near its ends none is askew, so that all stretches fit."""
    streets: list[SideStreet] = []
    for _ in range(min(rng.poisson(_SIDE_STREETS[kind] * Stretch.FURTHER.share_around(42.0)), 8)):
        u = rng.uniform(-1, 1) * (LENGTH_M / 2 - _FROM_END_M)
        skew = np.clip(rng.normal(0, 0.25), -0.5, 0.5) if abs(u) < LENGTH_M / 2 - _SKEW_FROM_END_M else 0.0
        sides = ((-1, 1), (1,), (-1,))[rng.choice(3, p=[0.4, 0.3, 0.3])]
        half, pavement = rng.uniform(2.3, 4.0), 0.0 if kind == "country" else rng.uniform(1.0, 2.2)
        if all(abs(u - other.u_m) > 32 for other in streets):
            streets.append(SideStreet(u, half, pavement, sides, float(skew)))
    return tuple(streets)


def _sample_side_streets(rng: np.random.Generator, kind: str) -> tuple[SideStreet, ...]:
    streets: list[SideStreet] = []
    for _ in range(min(rng.poisson(_SIDE_STREETS[kind]), 4)):
        u, skew = rng.normal(0, 42), float(np.clip(rng.normal(0, 0.25), -0.5, 0.5))
        sides = ((-1, 1), (1,), (-1,))[rng.choice(3, p=[0.4, 0.3, 0.3])]
        half, pavement = rng.uniform(2.3, 4.0), 0.0 if kind == "country" else rng.uniform(1.0, 2.2)
        if abs(u) < 95 and all(abs(u - other.u_m) > 32 for other in streets):
            streets.append(SideStreet(float(u), half, pavement, sides, skew))
    return tuple(streets)


def _sample_line(rng: np.random.Generator, kind: str) -> np.ndarray:
    """Sample a gentle arc, in most streets with a bend or two."""
    u = np.arange(-260.0, 261.0, 2.0)
    yaw = rng.normal(0, 0.0012) * u
    for side in (-1, 1):
        if rng.random() < (0.6 if kind != "country" else 0.7):
            at, length = side * rng.uniform(22, 85), rng.uniform(10, 25)
            yaw += rng.uniform(-0.75, 0.75) * (np.tanh((u - at) / length) + side)
    middle = (yaw[1:] + yaw[:-1]) / 2
    steps = np.stack((np.cos(middle), np.sin(middle)), axis=1) * 2.0
    xy = np.concatenate((np.zeros((1, 2)), np.cumsum(steps, axis=0)))
    xy -= xy[len(u) // 2]
    return np.column_stack((u, xy, np.cos(yaw), np.sin(yaw)))


def _sample_waves(rng: np.random.Generator) -> np.ndarray:
    """Sample waves of the ground whose slopes have a spread of about one in sixty each."""
    length, turn = np.exp(rng.uniform(np.log(45), np.log(260), 4)), rng.uniform(0, 2 * np.pi, 4)
    number = 2 * np.pi / length
    amplitude = rng.normal(0, 0.016, 4) / number
    return np.column_stack((amplitude, number * np.cos(turn), number * np.sin(turn), rng.uniform(0, 2 * np.pi, 4)))
