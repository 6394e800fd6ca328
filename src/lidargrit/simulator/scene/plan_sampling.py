"""Sampling of plans: random numbers → the roads, side streets and ground of one street."""

import numpy as np

from lidargrit.simulator.scene.street_plan import PARKING_M, SideStreet, StreetPlan, Theme
from lidargrit.simulator.scene.stretches import LENGTH_M, Stretch

_PARK_CHANCE = {"city": (0.65, 0.65), "suburb": (0.5, 0.5), "country": (0.0, 0.0)}  # right, left
_LANE_M = {"city": (2.9, 3.7), "suburb": (2.7, 3.4), "country": (2.8, 3.4)}
_PAVEMENT_M = {"city": (2.0, 4.5), "suburb": (1.2, 2.8), "country": (0.0, 0.01)}
_SETBACK_M = {"city": (0.0, 2.5), "suburb": (1.5, 6.5), "country": (5.0, 18.0)}
_SIDE_STREETS = {"city": 2.4, "suburb": 2.4, "country": 0.5}  # how many on average
_WIDE_CHANCE = {"city": 0.15, "suburb": 0.06, "country": 0.0}  # of more lanes, bays across, or a strip in between
_WIDER_M = (2.5, 9.0)
_AVENUE_CHANCE = {"city": 0.1, "suburb": 0.02, "country": 0.0}  # of one or two more lanes on both sides
_OPEN_CHANCE = {"city": 0.08, "suburb": 0.05, "country": 0.0}  # of a square: houses far back on one side
_OPEN_M = (10.0, 45.0)
_SPEED_M_S = {"city": (2.0, 11.0), "suburb": (3.0, 11.0), "country": (9.0, 22.0)}
_END_CHANCE = {"city": 0.45, "suburb": 0.6, "country": 0.15}  # of a side street that ends at a house across
_END_M = (15.0, 50.0)  # from the farther line of houses
_JUNCTION_CHANCE = {"city": 0.45, "suburb": 0.45, "country": 0.0}  # of a road that begins at a street across
_JUNCTION_M, _JUNCTION_FROM_M_S = (42.0, 60.0), 4.0  # from where we begin; our speed, unless we stand
_BEND_CHANCE = {"city": 0.8, "suburb": 0.85, "country": 0.75}  # ahead, and as often behind
_BEND_AT_M, _BEND_RAD = (15.0, 55.0), (0.15, 0.65)  # from where we begin, and half the turn
_BEND_CLEAR_M = 8.0  # from the middle of a bend to that of a side street, which would fan out there
_FROM_END_M, _SKEW_FROM_END_M = 26.0, 75.0  # side streets, and those askew, to the end of their further stretch


def sample_street_plan(rng: np.random.Generator, theme: Theme) -> StreetPlan:
    """Sample roads and ground of one theme."""
    kind = str(rng.choice(["suburb", "city", "country"], p=[0.52, 0.38, 0.10])) if theme == "mixed" else theme
    lanes = 2 if kind == "country" or rng.random() < {"city": 0.8, "suburb": 0.5}[kind] else 1
    lane = rng.uniform(*_LANE_M[kind]) * (1.0 if lanes == 2 else rng.uniform(1.25, 1.6))
    parked = rng.random(2) < _PARK_CHANCE[kind]
    edge = lane * lanes / 2 + np.where(parked, PARKING_M, rng.uniform(0.15, 0.4, 2))
    close = 0.15 if kind == "suburb" and rng.random() < 0.2 else 1.0  # streets without front gardens
    setback = close * rng.uniform(*_SETBACK_M[kind], 2)
    edge += np.where(rng.random(2) < _WIDE_CHANCE[kind], rng.uniform(*_WIDER_M, 2), 0.0)
    if rng.random() < _AVENUE_CHANCE[kind]:
        edge += lane * rng.integers(1, 3)
    setback += np.where(rng.random(2) < _OPEN_CHANCE[kind], rng.uniform(*_OPEN_M, 2), 0.0)
    pavement = rng.uniform(*_PAVEMENT_M[kind], 2)
    speed = 0.0 if rng.random() < 0.15 else float(rng.uniform(*_SPEED_M_S[kind]))
    across, ends = _sample_ends(rng, kind, speed)
    streets = _sample_side_streets(rng, kind, float((edge + pavement + setback).max()), across)
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
        bridge_u_m=bridge if ends[0] < bridge < ends[1] else np.inf,
        ends_m=ends,
        line=_sample_line(rng, kind, streets),
        waves=_sample_waves(rng),
        tilt=rng.normal(0, 0.016, 2),
        camber=rng.uniform(0.005, 0.035),
        banks_m=(rng.normal(0.2, 1.0), rng.normal(0.2, 1.0)) if wild else (0.0, 0.0),
        level_m=(0.0, -0.03) if wild else (rng.uniform(0.06, 0.15), rng.uniform(0.1, 0.25)),
        speed_m_s=speed,
    )


def sample_bridge(rng: np.random.Generator, streets: tuple[SideStreet, ...], to_m: float = 70.0) -> float:
    """Sample where another road crosses above ours, within a distance and clear of side streets; mostly nowhere."""
    bridge = rng.uniform(14, to_m) * rng.choice([-1, 1]) if rng.random() < 0.06 else np.inf
    return np.inf if any(abs(street.u_m - bridge) < 22 for street in streets) else float(bridge)


def _sample_ends(rng: np.random.Generator, kind: str, speed_m_s: float) -> tuple[list[SideStreet], tuple[float, float]]:
    """Sample streets across at which our road begins, and ends if our car stands.

    We leave such a beginning at a speed at which what drives towards it gets there out of our sight.
    """
    across, ends = [], [-np.inf, np.inf]
    stands = speed_m_s == 0
    for which, side, may in ((0, -1, stands or speed_m_s > _JUNCTION_FROM_M_S), (1, 1, stands)):
        if rng.random() > _JUNCTION_CHANCE[kind] or not may:
            continue
        u, half, pavement = side * rng.uniform(*_JUNCTION_M), rng.uniform(2.3, 4.0), rng.uniform(1.0, 2.2)
        across.append(SideStreet(u, half, pavement, (-1, 1), 0.0))
        ends[which] = u + side * (half + pavement + 0.3)
    return across, (float(ends[0]), float(ends[1]))


def _sample_end(rng: np.random.Generator, kind: str, front_m: float) -> float:
    end = front_m + rng.uniform(*_END_M)
    return float(end) if rng.random() < _END_CHANCE[kind] else np.inf


def sample_further_streets(rng: np.random.Generator, kind: str, front_m: float) -> tuple[SideStreet, ...]:
    """Sample the side streets of a further stretch; near its ends none is askew, so that all stretches fit.

    Args:
        front_m: distance from the middle of our road to the farther line of houses.
    """
    streets: list[SideStreet] = []
    for _ in range(min(rng.poisson(_SIDE_STREETS[kind] * Stretch.FURTHER.share_around(42.0)), 8)):
        u = rng.uniform(-1, 1) * (LENGTH_M / 2 - _FROM_END_M)
        skew = np.clip(rng.normal(0, 0.25), -0.5, 0.5) if abs(u) < LENGTH_M / 2 - _SKEW_FROM_END_M else 0.0
        sides = ((-1, 1), (1,), (-1,))[rng.choice(3, p=[0.4, 0.3, 0.3])]
        half, pavement = rng.uniform(2.3, 4.0), 0.0 if kind == "country" else rng.uniform(1.0, 2.2)
        if all(abs(u - other.u_m) > 32 for other in streets):
            streets.append(SideStreet(u, half, pavement, sides, float(skew), _sample_end(rng, kind, front_m)))
    return tuple(streets)


def _sample_side_streets(
    rng: np.random.Generator, kind: str, front_m: float, across: list[SideStreet]
) -> tuple[SideStreet, ...]:
    streets = list(across)
    for _ in range(min(rng.poisson(_SIDE_STREETS[kind]), 4)):
        u, skew = rng.normal(0, 42), float(np.clip(rng.normal(0, 0.25), -0.5, 0.5))
        sides = ((-1, 1), (1,), (-1,))[rng.choice(3, p=[0.4, 0.3, 0.3])]
        half, pavement = rng.uniform(2.3, 4.0), 0.0 if kind == "country" else rng.uniform(1.0, 2.2)
        beyond = any(abs(u) > abs(other.u_m) and u * other.u_m > 0 for other in across)
        if abs(u) < 95 and not beyond and all(abs(u - other.u_m) > 32 for other in streets):
            end_m = _sample_end(rng, kind, front_m)
            streets.append(SideStreet(float(u), half, pavement, sides, skew, end_m))
    return tuple(streets)


def _sample_line(rng: np.random.Generator, kind: str, streets: tuple[SideStreet, ...]) -> np.ndarray:
    """Sample a gentle arc, in most streets with bends that end the view along them, away from side streets."""
    u = np.arange(-260.0, 261.0, 2.0)
    yaw = rng.normal(0, 0.0012) * u
    left = rng.choice([-1, 1])
    for side, way in ((-1, left), (1, left if rng.random() < 0.35 else -left)):
        if rng.random() < _BEND_CHANCE[kind]:
            length, places = rng.uniform(10, 25), side * rng.uniform(*_BEND_AT_M, 12)
            at = max(places, key=lambda u: min(min((abs(u - s.u_m) for s in streets), default=99.0), length + 6.0))
            clear = all(abs(at - street.u_m) > _BEND_CLEAR_M for street in streets)
            yaw += clear * way * rng.uniform(*_BEND_RAD) * (np.tanh((u - at) / length) + side)
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
