"""A street that goes on: a seed → stretch after stretch of one road, of which those near our car are kept."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float64

from lidargrit.simulator.mesh import Mesh, Objects
from lidargrit.simulator.scene import Scene, Theme, sample_attitude
from lidargrit.simulator.scene.layout import oncoming_speed_m_s
from lidargrit.simulator.scene.objects import ObjectBatch
from lidargrit.simulator.scene.parts import Parts, lay_out_first, lay_out_further, lay_out_rest
from lidargrit.simulator.scene.plan_sampling import sample_bridge, sample_further_streets, sample_street_plan
from lidargrit.simulator.scene.street_plan import SideStreet, StreetPlan
from lidargrit.simulator.scene.stretches import EXTENT_M, LENGTH_M, Stretch

_KNOT_M = 2.0  # from one knot of the line to the next
_LAST_KNOT_M = 126.0  # of the first stretch: the first knot behind its end
_BRIDGE_FROM_END_M = 40.0
_HEADING_RAD, _HEADING_AT_MOST_RAD = 0.45, 0.9  # of the road at the end of a stretch, so that it never meets itself
_BEND_M, _BEND_AT_M, _RADIUS_M = (15.0, 35.0), 50.0, 60.0
_ONCOMING = (0.8, 1.2)  # of our speed, where nobody comes towards us in the first stretch
_IN_OUR_WAY_M = 1.6  # from the middle of our car to that of another's, at most
_INSTANCES, _INSTANCES_APART = 65_535, 512  # labels hold 16 bits; no stretch has so many objects


@dataclass(frozen=True, eq=False)
class _Sketch:
    """Line and junctions of a stretch, and its random stream for all else."""

    line: Float[np.ndarray, "k 5"]
    streets: tuple[SideStreet, ...]
    bridge_u_m: float
    rng: np.random.Generator


class LongRoad:
    """The street of a seed, with further stretches beyond the end of its first one.

    The first stretch is that of :func:`sample_scene`, with details all along. Every further stretch has a random stream
    of its own, so that it is the same whichever was asked for before. Of what stands, the stretch where our car is and
    its neighbours are kept, so that all it may see within 150 m is there, and memory stays flat.

    Args:
        seed: seed of the drive.
        theme: kind of street.
    """

    def __init__(self, seed: int, theme: Theme) -> None:
        self._seed = seed
        self.rng = np.random.default_rng(seed).spawn(2)[0]
        """Random stream of the street, after its first stretch was sampled."""
        self._plan = sample_street_plan(self.rng, theme)
        first = lay_out_first(self.rng, self._plan, to_the_end=True)
        self._attitude_rad = sample_attitude(self.rng)
        rest_rng = self._stream(0)
        speed_m_s = oncoming_speed_m_s(first.moving)
        fast = max(self._plan.speed_m_s, 3.0) * rest_rng.uniform(*_ONCOMING)
        self._oncoming_m_s = fast if speed_m_s is None else speed_m_s
        first = lay_out_rest(rest_rng, self._plan, first)
        self._first = replace(first, moving=tuple(self._passes_us(batch) for batch in first.moving))
        self._starts = [self._plan.line[0], self._plan.line[self._plan.line[:, 0] <= _LAST_KNOT_M][-1]]
        self._parts: dict[int, Parts] = {}
        self._scene: tuple[int, Scene] | None = None

    def scene_at(self, time_s: float) -> Scene:
        """Return what is around our car at a time of the drive, in seconds."""
        number = self._number_at(time_s)
        if self._scene is None or self._scene[0] != number:
            self._scene = number, self._around(number)
        return self._scene[1]

    def poses_at(self, times_s: Sequence[float], height_m: float) -> list[Float64[np.ndarray, "4 4"]]:
        """Return the frame of a sensor in the world of the drive at times, in seconds, at a height above the road."""
        poses, bare = [], None
        for time_s in times_s:
            number = self._number_at(time_s)
            if bare is None or bare[0] != number:
                empty = Mesh.of(np.zeros((0, 3, 3)), 0, 0.0, 0), Objects.none(), ()
                bare = number, self._scene_of(number, *empty)
            poses.append(bare[1].in_drive(bare[1].sensor_pose(time_s, height_m)))
        return poses

    def _number_at(self, time_s: float) -> int:
        beyond_m = self._plan.speed_m_s * time_s - EXTENT_M
        return 1 + int(beyond_m // LENGTH_M) if beyond_m >= 0 else 0

    def _scene_of(self, number: int, standing: Mesh, still: Objects, moving: tuple[ObjectBatch, ...]) -> Scene:
        begins_s = _middle_m(number) / self._plan.speed_m_s
        plan = self._plan_of(number)
        return Scene(plan, standing, still, moving, self._attitude_rad, begins_s)

    def _around(self, number: int) -> Scene:
        numbers = range(max(number - 1, 0), number + 2)
        self._parts = {n: self._parts[n] if n in self._parts else self._laid_out(n) for n in numbers}
        here_m, standing, still, moving = self._plan_of(number).offset_m, [], [], []
        for other, parts in self._parts.items():
            apart_m = self._plan_of(other).offset_m - here_m
            shifted = (parts.standing.triangles_m + apart_m).astype(np.float32)
            standing.append(replace(parts.standing, triangles_m=shifted))
            frame = parts.still.frame.copy()
            frame[:, :3, 3] += apart_m
            still.append(replace(parts.still, frame=frame, instance=_instances(parts.still.instance, other)))
        for other, parts in {0: self._first, **self._parts}.items():  # those who drive before us never leave
            moving += [self._seen_from(number, other, batch) for batch in parts.moving]
        return self._scene_of(number, Mesh.join(standing), Objects.join(still), tuple(moving))

    def _laid_out(self, number: int) -> Parts:
        if number == 0:
            return self._first
        taken_m = self._first.town.boxes_m - _middle_m(1) * np.array([1, 1, 0, 0]) if number == 1 else None
        return lay_out_further(
            self._sketch(number).rng, self._plan_of(number), self._first, taken_m, self._oncoming_m_s
        )

    def _seen_from(self, number: int, home: int, batch: ObjectBatch) -> ObjectBatch:
        """Return things that move in the coordinates, and since the time 0, of another stretch."""
        since_s = (_middle_m(number) - _middle_m(home)) / self._plan.speed_m_s
        u_m, v_m = batch.placements.positions_at(since_s)
        placements = replace(batch.placements, u_m=u_m + _middle_m(home) - _middle_m(number), v_m=v_m)
        return replace(batch, placements=placements, instance=_instances(batch.instance, home))

    def _passes_us(self, batch: ObjectBatch) -> ObjectBatch:
        """Leave out those who come towards us in our own lane, which a drive of 100 m hardly notices."""
        places = batch.placements
        towards = ~places.across & (np.cos(places.turn_rad) < 0)
        return batch.select(np.flatnonzero(~(towards & (np.abs(places.v_m - self._plan.our_v_m) < _IN_OUR_WAY_M))))

    def _plan_of(self, number: int) -> StreetPlan:
        """Return the plan of a stretch, whose line goes on through its neighbours."""
        near = {n: self._sketch(n) for n in range(max(number - 1, 0), number + 2)}
        line = np.concatenate([
            near[n].line[: None if n == number + 1 else -1] + np.array([_middle_m(n) - _middle_m(number), 0, 0, 0, 0])
            for n in near
        ])  # fmt: skip
        if number == 0:
            return replace(self._plan, line=line)
        bends = tuple(
            replace(street, u_m=street.u_m + _middle_m(n) - _middle_m(number))
            for n, sketch in near.items()
            for street in sketch.streets
            if n != number and street.skew
        )
        here = near[number]
        anchor = here.line[len(here.line) // 2, 1:3]
        line[:, 1:3] -= anchor
        return replace(
            self._plan,
            side_streets=here.streets,
            bridge_u_m=here.bridge_u_m,
            ends_m=(-np.inf, np.inf),
            line=line,
            stretch=Stretch.FURTHER,
            neighbours=bends,
            place=self._plan.place_of(anchor),
        )

    def _sketch(self, number: int) -> _Sketch:
        """Sketch a stretch, whose line begins where the one before ends."""
        if number == 0:
            line = self._plan.line[self._plan.line[:, 0] <= _LAST_KNOT_M]
            return _Sketch(line, self._plan.side_streets, self._plan.bridge_u_m, self.rng)
        while len(self._starts) <= number:
            self._starts.append(_line_from(self._stream(len(self._starts) - 1), self._starts[-1])[-1])
        rng = self._stream(number)
        line = _line_from(rng, self._starts[number])
        streets = sample_further_streets(rng, self._plan.theme, self._plan.farthest_front_m)
        return _Sketch(line, streets, sample_bridge(rng, streets, LENGTH_M / 2 - _BRIDGE_FROM_END_M), rng)

    def _stream(self, number: int) -> np.random.Generator:
        """Return the random stream of a stretch: a child of the street's, which its first stretch does not use."""
        return np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(0, number)))


def _middle_m(number: int) -> float:
    """Return where the middle of a stretch lies along the road; a drive begins in the middle of the first one."""
    return EXTENT_M + LENGTH_M * (number - 0.5) if number else 0.0


def _line_from(rng: np.random.Generator, knot: np.ndarray) -> Float[np.ndarray, "k 5"]:
    """Sample the line of a further stretch: one bend, from the end of the stretch before."""
    u = _LAST_KNOT_M - _middle_m(1) + np.arange(0.0, LENGTH_M + _KNOT_M, _KNOT_M)
    start = float(np.arctan2(knot[4], knot[3]))
    turn = float(np.clip(rng.normal(0, _HEADING_RAD), -_HEADING_AT_MOST_RAD, _HEADING_AT_MOST_RAD)) - start
    at, length = rng.uniform(-_BEND_AT_M, _BEND_AT_M), max(rng.uniform(*_BEND_M), abs(turn) / 2 * _RADIUS_M)
    share = np.tanh((u - at) / length)
    yaw = start + turn * (share - share[0]) / (share[-1] - share[0])
    middle = (yaw[1:] + yaw[:-1]) / 2
    steps = np.stack((np.cos(middle), np.sin(middle)), axis=1) * _KNOT_M
    xy = knot[1:3] + np.concatenate((np.zeros((1, 2)), np.cumsum(steps, axis=0)))
    return np.column_stack((u, xy, np.cos(yaw), np.sin(yaw)))


def _instances(instance: np.ndarray, number: int) -> np.ndarray:
    """Return numbers of objects that differ between stretches, until labels of 16 bits begin anew after 27 km."""
    apart = (instance.astype(np.int64) - 1 + _INSTANCES_APART * number) % _INSTANCES + 1
    return np.where(instance > 0, apart, 0).astype(np.int32)
