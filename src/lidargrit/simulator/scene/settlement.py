"""Positions of houses: a plan → rows along the streets, garages, blocks behind, and the gaps between."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Num

from lidargrit.simulator import materials
from lidargrit.simulator.scene.buildings import Houses
from lidargrit.simulator.scene.objects import Placements
from lidargrit.simulator.scene.street_plan import StreetPlan
from lidargrit.simulator.scene.stretches import EXTENT_M, Stretch

_LENGTH_M = {"city": (8.0, 20.0), "suburb": (7.5, 14.0), "country": (9.0, 18.0)}
_DEPTH_M = {"city": (9.0, 13.0), "suburb": (7.5, 11.0), "country": (8.0, 14.0)}
_STOREYS = {"city": (2, 6), "suburb": (1, 4), "country": (1, 3)}
_GAP_CHANCE = {"city": 0.22, "suburb": 0.65, "country": 1.0}
_GAP_M = {"city": (2.5, 9.0), "suburb": (2.5, 9.0), "country": (10.0, 90.0)}
_BEHIND = {"city": 0.85, "suburb": 0.8, "country": 0.1}  # share of the places behind the rows that are built on
_HOUSE, _GARAGE, _LONG = range(3)
_PARK_CHANCE = {"city": 0.07, "suburb": 0.13, "country": 0.3}
_LATTICE_M, _LONG_LATTICE_M = 15.0, 46.0
_APART_M = (1.0, 8.0)  # between houses behind the rows, at least
_LONG_CHANCE = {"city": (0.2, 0.9), "suburb": (0.0, 0.7), "country": (0.0, 0.15)}  # of a long block in its places
_LONG_BEHIND_M = 18.0  # the line of houses, at least
_LONG_STOREYS = {"city": (3, 9), "suburb": (2, 6), "country": (2, 4)}
# How far from the middle of a stretch houses stand along side streets; those of further ones end within them.
_BESIDE_TO_M = {Stretch.FIRST: 122.0, Stretch.FURTHER: Stretch.FURTHER.built_m - 7.0}


@dataclass(frozen=True, eq=False)
class Settlement:
    """Houses and where they leave room.

    Args:
        houses: all houses of the scene.
        boxes_m: bounds of each house, and of some of the stretch before: lowest u, highest u, lowest v, highest v.
        gaps_m: gaps in the rows of houses along our road: first u, last u and side.
        parks_m: stretches without houses: first u, last u and side.
    """

    houses: Houses
    boxes_m: Float[np.ndarray, "n 4"]
    gaps_m: Float[np.ndarray, "g 3"]
    parks_m: Float[np.ndarray, "p 3"]

    def covers(self, u_m: Num[np.ndarray, " p"], v_m: Num[np.ndarray, " p"], spare_m: float) -> Bool[np.ndarray, " p"]:
        """Return which points lie in a house, or nearer to one than a margin."""
        return _covered(self.boxes_m, np.asarray(u_m), np.asarray(v_m), spare_m)


def _covered(boxes: np.ndarray, u: np.ndarray, v: np.ndarray, spare: float | np.ndarray) -> Bool[np.ndarray, " p"]:
    spare = np.asarray(spare)[..., None]
    inside_u = (u[:, None] > boxes[:, 0] - spare) & (u[:, None] < boxes[:, 1] + spare)
    inside_v = (v[:, None] > boxes[:, 2] - spare) & (v[:, None] < boxes[:, 3] + spare)
    return np.any(inside_u & inside_v, axis=1)


def _overlap(boxes: np.ndarray, others: np.ndarray) -> Bool[np.ndarray, " n"]:
    """Return which boxes share ground with any of the others."""
    apart = (boxes[:, None, [0, 2]] > others[:, [1, 3]]) | (boxes[:, None, [1, 3]] < others[:, [0, 2]])
    return np.any(~np.any(apart, axis=2), axis=1)


def from_road_m(plan: StreetPlan, u_m: Num[np.ndarray, " p"], v_m: Num[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Return how far points lie from the middle of our road in the world, where it may turn back towards them."""
    along = np.arange(-plan.stretch.half_m, plan.stretch.half_m, 6.0)
    road = plan.ground_points(along, 0 * along)[:, :2]
    apart = plan.ground_points(u_m, v_m)[:, None, :2] - road
    return np.sqrt((apart**2).sum(axis=2).min(axis=1))


def free_spans(plan: StreetPlan, side: int, spare_m: float = 0.5) -> list[tuple[float, float]]:
    """Return from where to where our road has land beside it on one side: no side street, no bridge."""
    taken = [
        (s.u_m, s.half_m + s.pavement_m + spare_m + 6.0 * abs(s.skew)) for s in plan.side_streets if side in s.sides
    ]
    if np.isfinite(plan.bridge_u_m):
        taken.append((plan.bridge_u_m, 13.0 + spare_m))  # its banks
    spans, start = [], max(-plan.stretch.built_m, plan.ends_m[0])
    for middle, half in sorted(taken):
        if middle - half - start > 4:
            spans.append((start, middle - half))
        start = max(start, middle + half)
    last = min(plan.stretch.built_m, plan.ends_m[1])
    return [*spans, (start, last)] if last > start else spans


def lay_out_houses(
    rng: np.random.Generator, plan: StreetPlan, taken_m: Float[np.ndarray, "n 4"] | None = None
) -> Settlement:
    """Sample where houses stand.

    Args:
        taken_m: bounds of houses of the stretch before, some of which may lie in this one.
    """
    rows, gaps, parks = [], [np.zeros((0, 3))], [np.zeros((0, 3))]
    for side in (-1, 1):
        for span in free_spans(plan, side):
            if rng.random() < _PARK_CHANCE[plan.theme]:
                parks.append(np.array([(*span, side)]))
                continue
            start, length = _row(rng, plan.theme, span)
            front = side * plan.front(side) + _steps(rng, len(start))
            rows.append((start, length, front, np.full(len(start), side)))
            from_, to = np.append(span[0], start + length), np.append(start, span[1])
            gap = np.column_stack((from_, to, np.full(len(to), side)))
            gaps.append(gap[gap[:, 1] - gap[:, 0] > 1.5])
    blocks = [_stand_along(start, length, front, side, rng.uniform(*_DEPTH_M[plan.theme], len(start)))
              for start, length, front, side in rows]  # fmt: skip
    blocks += [_stand_beside(rng, plan, street, side, flank) for street in plan.side_streets for side in street.sides
               for flank in (-1, 1)]  # fmt: skip
    blocks += _stand_across(rng, plan)
    garages = _garages(rng, plan, np.concatenate(gaps))
    blocks.append(garages)
    long = _stand_far(rng, plan, np.concatenate([b[1] for b in blocks]))
    blocks.append(long)
    blocks.append(_stand_behind(rng, plan, np.concatenate([b[1] for b in blocks])))
    placements = Placements.join([b[0] for b in blocks])
    extents = np.concatenate([b[1] for b in blocks])
    size = np.concatenate([b[2] for b in blocks])
    kind = np.concatenate([np.full(len(b[0]), _GARAGE if b is garages else _LONG if b is long else _HOUSE)
                           for b in blocks])  # fmt: skip
    if taken_m is not None:
        free = ~_overlap(extents, taken_m)
        placements, size, kind, extents = placements.select(free), size[free], kind[free], extents[free]
    houses = _sample_houses(rng, plan, placements, size, kind)
    boxes = extents if taken_m is None else np.concatenate((extents, taken_m))
    return Settlement(houses, boxes, np.concatenate(gaps), np.concatenate(parks))


def _row(rng: np.random.Generator, theme: str, span: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Fill a span with houses and gaps; contiguous rows occur in every theme."""
    count = int((span[1] - span[0]) / 7) + 2
    length = rng.uniform(*_LENGTH_M[theme], count)
    closed = theme == "suburb" and rng.random() < 0.2
    gap = rng.uniform(*_GAP_M[theme], count) * (rng.random(count) < (0.15 if closed else _GAP_CHANCE[theme]))
    ends = span[0] + np.cumsum(length + gap)
    start = ends - length
    fits = ends <= span[1]
    start, length = start[fits], length[fits]
    rest = span[1] - (ends[fits][-1] if fits.any() else span[0])
    if rest > 6 and theme != "country":  # a last house up to the corner
        start, length = np.append(start, span[1] - rest), np.append(length, min(rest, 16.0))
    return start, length


def _steps(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return how far each house stands behind the line."""
    back = rng.uniform(0, 0.5, count)
    return back + np.where(rng.random(count) < 0.25, rng.uniform(1.0, 8.0, count), 0.0)


def _stand_along(
    start: np.ndarray, length: np.ndarray, front: np.ndarray, side: np.ndarray, depth: np.ndarray
) -> tuple[Placements, np.ndarray, np.ndarray]:
    """Line our road with houses that face it, each from where it starts and with a front so far from the middle."""
    placements = Placements.of(start + length / 2, side * (front + depth / 2), np.where(side > 0, 0.0, np.pi))
    near, far = side * front, side * (front + depth)
    extent = np.column_stack((start, start + length, np.minimum(near, far), np.maximum(near, far)))
    return placements, extent, np.column_stack((length, depth))


def _stand_beside(
    rng: np.random.Generator, plan: StreetPlan, street, side: int, flank: int
) -> tuple[Placements, np.ndarray, np.ndarray]:
    """Line one flank of a side street, from behind the corner house on."""
    first = abs(plan.front(side)) + 14.0 + rng.uniform(0, 6)
    start, length = _row(rng, plan.theme, (first, max(min(112.0, street.end_m - 1.0), first)))
    depth = rng.uniform(*_DEPTH_M[plan.theme], len(start))
    front = street.half_m + street.pavement_m + min(plan.setback_m) * 0.7 + _steps(rng, len(start))
    u_near, u_far = street.u_m + flank * front, street.u_m + flank * (front + depth)
    others = np.array([s.u_m for s in plan.side_streets if s is not street and side in s.sides])
    middle_u = (u_near + u_far) / 2
    clear = (np.abs(middle_u[:, None] - others) > depth[:, None] / 2 + 6.0).all(axis=1) & (
        np.abs(middle_u) < _BESIDE_TO_M[plan.stretch]
    )
    if np.isfinite(plan.bridge_u_m):
        clear &= (np.abs(middle_u - plan.bridge_u_m) > 18) | (start > 75)
    placements = Placements.of(middle_u, side * (start + length / 2), np.pi if flank > 0 else 0.0, across=True)
    v_from, v_to = side * start, side * (start + length)
    extent = np.column_stack(
        (np.minimum(u_near, u_far), np.maximum(u_near, u_far), np.minimum(v_from, v_to), np.maximum(v_from, v_to))
    )
    return placements.select(clear), extent[clear], np.column_stack((length, depth))[clear]


def _stand_across(rng: np.random.Generator, plan: StreetPlan) -> list[tuple[Placements, np.ndarray, np.ndarray]]:
    """Build houses across the ends of streets, which face them."""
    blocks = []
    for street in plan.side_streets:
        for side in street.sides if np.isfinite(street.end_m) else ():
            length, depth = rng.uniform(13, 26), rng.uniform(*_DEPTH_M[plan.theme])
            near = street.end_m + rng.uniform(0.5, 5.0)
            u, v = street.u_m + rng.uniform(-2, 2), side * (near + depth / 2)
            if not abs(u) + length / 2 < plan.stretch.built_m:
                continue
            extent = np.array([[u - length / 2, u + length / 2, v - depth / 2, v + depth / 2]])
            placement = Placements.of(np.array([u]), v, 0.0 if side > 0 else np.pi)
            blocks.append((placement, extent, np.array([[length, depth]])))
    for end, way in zip(plan.ends_m, (-1, 1), strict=True):
        if np.isfinite(end):
            reach, wide, middle = plan.farthest_front_m + 20.0, rng.uniform(6, 11), rng.uniform(-3, 3)
            rows = [_row(rng, plan.theme, span) for span in ((-reach, middle - wide), (middle + wide, reach))]
            start = np.concatenate((rows[0][0], rows[1][0], [middle - wide]))  # the last one closes the view
            length = np.concatenate((rows[0][1], rows[1][1], [2 * wide]))
            depth = rng.uniform(*_DEPTH_M[plan.theme], len(start))
            near = end + way * (rng.uniform(0.5, 4.0) + _steps(rng, len(start)))
            far = near + way * depth
            extent = np.column_stack((np.minimum(near, far), np.maximum(near, far), start, start + length))
            turn = 0.0 if way < 0 else np.pi
            placement = Placements.of((near + far) / 2, start + length / 2, turn, across=True)
            blocks.append((placement, extent, np.column_stack((length, depth))))
    return blocks


def _garages(rng: np.random.Generator, plan: StreetPlan, gaps: np.ndarray) -> tuple[Placements, np.ndarray, np.ndarray]:
    wide = gaps[:, 1] - gaps[:, 0]
    chosen = (wide > 3.2) & (rng.random(len(gaps)) < {"city": 0.25, "suburb": 0.45, "country": 0.1}[plan.theme])
    gap, length = gaps[chosen], np.minimum(wide[chosen] - 0.3, rng.uniform(2.9, 6.0, chosen.sum()))
    side = gap[:, 2]
    front = np.where(side > 0, plan.front(1), -plan.front(-1)) + rng.uniform(0.5, 7.0, len(gap))
    start = gap[:, 0] + 0.1
    return _stand_along(start, length, front, side, rng.uniform(5.0, 7.0, len(gap)))


def _stand_far(
    rng: np.random.Generator, plan: StreetPlan, taken: np.ndarray
) -> tuple[Placements, np.ndarray, np.ndarray]:
    """Build long blocks far behind the rows, along our road or across; they close the view between nearer houses."""
    half_u, half_v = plan.stretch.half_m - 20, EXTENT_M - 20
    u, v = (a.ravel() for a in np.meshgrid(np.arange(-half_u, half_u, _LONG_LATTICE_M),
                                           np.arange(-half_v, half_v, _LONG_LATTICE_M)))  # fmt: skip
    count = len(u)
    u, v = u + rng.uniform(-9, 9, count), v + rng.uniform(-9, 9, count)
    size = np.column_stack((rng.uniform(20, 42, count), rng.uniform(9.5, 13, count)))
    across = rng.random(count) < 0.5
    half = np.where(across[:, None], size[:, ::-1], size) / 2
    behind = np.abs(v) - np.where(v > 0, plan.front(1), -plan.front(-1)) - half[:, 1]
    free = (rng.random(count) < rng.uniform(*_LONG_CHANCE[plan.theme])) & (behind > _LONG_BEHIND_M)
    free &= _off_streets(plan, u, v, half[:, 0], np.hypot(*half.T))
    extent = np.column_stack((u - half[:, 0], u + half[:, 0], v - half[:, 1], v + half[:, 1]))
    free &= ~_overlap(extent, taken)
    turn = np.where(v > 0, 0.0, np.pi) + np.where(across, np.pi / 2, 0.0)
    return Placements.of(u[free], v[free], turn[free]), extent[free], size[free]


def _off_streets(
    plan: StreetPlan, u: np.ndarray, v: np.ndarray, half_u: np.ndarray, reach: np.ndarray
) -> Bool[np.ndarray, " p"]:
    """Return which places behind the rows are clear of streets, of the bridge, and of the stretches beside."""
    pavement = max((s.pavement_m for s in plan.side_streets), default=0.0)
    free = plan.in_side_street(u, v, pavement) < -half_u
    free &= from_road_m(plan, u, v) > plan.farthest_front_m + reach
    if plan.stretch is Stretch.FURTHER:
        free &= np.abs(u) < plan.stretch.built_m - half_u
    return free & ~(np.abs(u - plan.bridge_u_m) < 13 + half_u)


def _stand_behind(
    rng: np.random.Generator, plan: StreetPlan, taken: np.ndarray
) -> tuple[Placements, np.ndarray, np.ndarray]:
    """Build behind the rows, as a backdrop, as densely inside a bend as outside; blocks of a city are large."""
    line = np.arange(-EXTENT_M + 8, EXTENT_M, _LATTICE_M)
    along = np.arange(-plan.stretch.half_m + 8, plan.stretch.half_m, _LATTICE_M)
    u, v = (a.ravel() for a in np.meshgrid(along, line))
    u, v = u + rng.uniform(-5, 5, len(u)), v + rng.uniform(-5, 5, len(v))
    size = rng.uniform(8, 15 if plan.theme != "city" else 21, (len(u), 2))
    reach = size.max(axis=1) / 2
    behind = np.maximum(v * np.sign(v) - np.where(v > 0, plan.front(1), -plan.front(-1)), 0)
    free = (rng.random(len(u)) < _BEHIND[plan.theme]) & (behind > reach + 3)
    free &= ~_covered(taken, u, v, reach + 1.0) & _off_streets(plan, u, v, reach, reach)
    free[free] = _apart(plan, np.column_stack((u, v))[free], reach[free], taken, rng.uniform(*_APART_M))
    u, v, size = u[free], v[free], size[free]
    placements = Placements.of(u, v, np.where(v > 0, 0.0, np.pi) + rng.choice([0, np.pi / 2], len(u)))
    half = size.max(axis=1) / 2
    return placements, np.column_stack((u - half, u + half, v - half, v + half)), size


def _apart(
    plan: StreetPlan, places: np.ndarray, reach: np.ndarray, taken: np.ndarray, gap_m: float
) -> Bool[np.ndarray, " p"]:
    """Choose places that lie apart in the world, from one another and from what stands."""
    xy = plan.ground_points(*places.T)[:, :2]
    others = plan.ground_points((taken[:, 0] + taken[:, 1]) / 2, (taken[:, 2] + taken[:, 3]) / 2)[:, :2]
    others_reach = np.minimum(taken[:, 1] - taken[:, 0], taken[:, 3] - taken[:, 2]) / 2
    from_others = np.linalg.norm(xy[:, None] - others, axis=2) - reach[:, None] - others_reach
    close = np.linalg.norm(xy[:, None] - xy, axis=2) < reach[:, None] + reach + gap_m
    kept = np.zeros(len(xy), bool)
    for at in np.flatnonzero((from_others > 0).all(axis=1)):
        kept[at] = not (close[at] & kept).any()
    return kept


def _sample_houses(
    rng: np.random.Generator, plan: StreetPlan, placements: Placements, size: np.ndarray, kind: np.ndarray
) -> Houses:
    count, plain = len(placements), kind == _GARAGE
    storey = rng.uniform(2.6, 3.0, count) if plan.theme != "city" else rng.uniform(2.8, 3.8, count)
    storeys = rng.integers(*_STOREYS[plan.theme], count)
    storeys = np.where(kind == _LONG, rng.integers(*_LONG_STOREYS[plan.theme], count), storeys)
    storey = np.where(plain, rng.uniform(2.3, 2.9, count), storey)
    height = np.where(plain, storey, storey * storeys + rng.uniform(0.0, 0.6, count))
    flat = plain | (rng.random(count) < (0.25 if plan.theme == "city" else 0.12))
    slope = rng.uniform(0.5, 1.0, count)
    material = rng.choice([materials.PLASTER, materials.BRICK, materials.CONCRETE], count, p=[0.72, 0.18, 0.1])
    bright = np.where(material == materials.PLASTER, rng.uniform(0.35, 0.85, count), rng.uniform(0.25, 0.55, count))
    return Houses(
        poses=plan.poses(placements.u_m, placements.v_m, placements.turn_rad, placements.across, plan.level_m[1]),
        length_m=size[:, 0],
        depth_m=size[:, 1],
        height_m=height,
        storey_m=storey,
        roof_m=np.where(flat, 0.0, size[:, 1] / 2 * slope),
        wall_material=material,
        wall_albedo=bright,
        plain=plain,
    )
