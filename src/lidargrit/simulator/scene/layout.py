"""Positions of everything but houses and trees: a plan and its houses → gardens, street furniture, traffic, people."""

from collections.abc import Sequence

import numpy as np

from lidargrit.simulator.scene import barriers, furniture
from lidargrit.simulator.scene.body_types import HATCHBACK
from lidargrit.simulator.scene.objects import ObjectBatch, Placements
from lidargrit.simulator.scene.people import make_cyclists, make_walkers
from lidargrit.simulator.scene.plants import make_hedges
from lidargrit.simulator.scene.settlement import Settlement, free_spans
from lidargrit.simulator.scene.shapes import MeshBuilder, owners, rows_of
from lidargrit.simulator.scene.street_plan import StreetPlan
from lidargrit.simulator.scene.stretches import Stretch
from lidargrit.simulator.scene.vehicles import make_vehicles, sample_vehicle_kinds

_OUR_LENGTH_M = 9.0  # from the middle of our car to that of the next in our lane, at least
_MET_APART_M = 8.0  # from where we meet one car to where we meet the next, at least
_PASSES_M = 1.6  # from the middle of our car to a cyclist's, at least
_SLOWER = 0.4  # than our car are walkers whom it meets later, at least, so that they come into sight far away
_PARKED_SHARE = {"city": (0.25, 0.85), "suburb": (0.1, 0.65), "country": (0.0, 0.1)}
_TRAFFIC = {"city": 4.0, "suburb": 1.5, "country": 1.5}
_OUTER_GAP_M = 22.0  # beyond the least, between cars in the outer lanes of a wide road
_WALKERS = {"city": 5.0, "suburb": 1.0, "country": 0.15}
_CYCLISTS = {"city": 0.8, "suburb": 0.35, "country": 0.15}
_ABOUT = {"city": 12.0, "suburb": 5.0, "country": 0.0}  # things that stand about on each pavement
_ABOUT_SHARES = {
    furniture.BIN: 0.3, furniture.CABINET: 0.16, furniture.BENCH: 0.08, furniture.PLANTER: 0.16,
    furniture.COLUMN: 0.03, furniture.SHELTER: 0.05, furniture.METER: 0.1, furniture.SIGNAL: 0.06,
    furniture.GUIDE: 0.06,
}  # fmt: skip
_BOUNDARY_TO_M = 75.0  # hedges and fences farther away hide behind nearer ones


def add_gardens(
    builder: MeshBuilder, rng: np.random.Generator, plan: StreetPlan, town: Settlement
) -> list[ObjectBatch]:
    """Line front gardens with walls and fences, and close some gaps; return the hedges."""
    lines: dict[str, list[tuple[float, float, float, float]]] = {"hedge": [], "wall": [], "fence": []}
    taste = rng.dirichlet([3.0, 1.3, 0.5])  # each street has its own
    lined = rng.uniform(0.25, 0.85)  # and its own share of front gardens without a boundary
    for which, side in enumerate((-1, 1)):
        edge = plan.edge_m[which] + plan.pavement_m[which] + 0.15
        for low, high in free_spans(plan, side) if plan.setback_m[which] > 1.3 and plan.theme != "country" else []:
            first, last = plan.stretch.span(_BOUNDARY_TO_M)
            along = max(low, first)
            while along < min(high, last):
                length = min(rng.uniform(4, 15), high - along)
                if rng.random() < lined and length > 1:
                    lines[str(rng.choice(list(lines), p=taste))].append((along, along + length, side * edge, side))
                along += length + rng.uniform(0.8, 3.6)
    ends = town.gaps_m[:, :2]
    nearer = np.take_along_axis(ends, np.abs(ends).argmin(axis=1)[:, None], axis=1)[:, 0]
    for u_from, u_to, side in town.gaps_m[plan.stretch.keeps(nearer, _BOUNDARY_TO_M)]:
        if rng.random() < 0.45 and plan.theme != "country":
            shut = rng.uniform(0.4, 1.0) * (u_to - u_from)
            kind = str(rng.choice(list(lines), p=taste))
            lines[kind].append((u_from, u_from + min(shut, 18.0), plan.front(int(side)) + side * 0.4, side))
    if plan.theme == "country" and plan.stretch is not Stretch.REST and rng.random() < 0.4:
        barriers.add_guard_rails(builder, rng, plan, int(rng.choice([-1, 1])))
    return _add_lines(builder, rng, plan, lines)


def _add_lines(
    builder: MeshBuilder, rng: np.random.Generator, plan: StreetPlan, lines: dict[str, list]
) -> list[ObjectBatch]:
    rise, hedges = plan.level_m[1], []
    for kind, add, heights, thick in (
        ("hedge", None, (0.8, 2.1), 0.9),
        ("wall", barriers.add_walls, (0.4, 1.9), 0.25),
        ("fence", barriers.add_fences, (0.8, 1.6), 0.0),
    ):
        if not lines[kind]:
            continue
        line = np.array(lines[kind])
        pieces = np.maximum(np.ceil((line[:, 1] - line[:, 0]) / 5.0), 1).astype(int)  # short ones follow the bends
        home, order = owners(pieces)
        step = ((line[:, 1] - line[:, 0]) / pieces)[home]
        start = line[home, 0] + order * step
        v = line[home, 2]
        u = np.column_stack((start, start + step))
        height = np.where(rng.random(len(line)) < 0.5, rng.uniform(*heights), rng.uniform(*heights, len(line)))
        across = np.column_stack((v, v + line[home, 3] * thick))
        if add is None:
            hedges.append(make_hedges(rng, u, across, height[home], rise))
        else:
            add(builder, rng, plan, u, across, height[home], rise)
    return hedges


def things(rng: np.random.Generator, plan: StreetPlan) -> ObjectBatch:
    """Set lamps, signs, and all that stands about on pavements."""
    wild = plan.theme == "country"
    rows = [_corner_signs(rng, plan)]  # columns: u, v, turn, kind, variant
    for which, side in enumerate((-1, 1)):
        edge, pavement = plan.edge_m[which], plan.pavement_m[which]
        if rng.random() < (0.15 if wild else 0.75):
            along = np.arange(*plan.stretch.span(95.0), rng.uniform(18, 34)) + rng.uniform(0, 15)
            v = side * (edge + _pole_offset(rng, pavement))
            rows.append(
                _beside(plan, along, v, -side * np.pi / 2, furniture.LAMP, int(rng.integers(furniture.VARIANTS)))
            )
        along = rng.uniform(*plan.stretch.span(70.0), rng.poisson((1.5 if wild else 3.0) * plan.stretch.share(70.0)))
        facing, v = 0.0 if side < 0 else np.pi, side * (edge + _pole_offset(rng, pavement))
        rows.append(_beside(plan, along, v, facing, furniture.SIGN, rng.integers(furniture.VARIANTS, size=len(along))))
        if wild or pavement < 1.2:
            continue
        rows.append(_standing_about(rng, plan, which, side))
        if rng.random() < 0.25:
            low, high = plan.stretch.span(40.0)
            first = rng.uniform(low, high - 10)
            along = np.arange(first, first + rng.uniform(6, 25), 2.0)
            variant = int(rng.integers(furniture.VARIANTS))
            rows.append(_beside(plan, along, side * (edge + 0.35), 0.0, furniture.BOLLARD, variant))
    u, v, turn, kind, variant = np.concatenate(rows).T
    placements = Placements.of(u, v, turn, rise_m=plan.level_m[0])
    return furniture.make_furniture(rng, kind.astype(int), variant.astype(int), placements)


def _standing_about(rng: np.random.Generator, plan: StreetPlan, which: int, side: int) -> np.ndarray:
    """Sample bins, cabinets, benches, tubs and the like: the low ones by the houses, few by the kerb."""
    count = rng.poisson(_ABOUT[plan.theme] * plan.stretch.share(60.0))
    kind = rng.choice(list(_ABOUT_SHARES), count, p=list(_ABOUT_SHARES.values()))
    at_kerb = np.isin(kind, (furniture.METER, furniture.SIGNAL, furniture.GUIDE)) | (rng.random(count) < 0.2)
    wide = np.where(kind == furniture.SHELTER, 1.0, 0.45)
    v = plan.edge_m[which] + np.where(at_kerb, 0.5, np.maximum(plan.pavement_m[which] - wide, 0.6))
    u, turn = rng.uniform(*plan.stretch.span(60.0), count), np.where(side < 0, -np.pi / 2, np.pi / 2) + 0 * v
    turn = np.where(np.isin(kind, (furniture.SIGNAL, furniture.GUIDE)), 0.0 if side < 0 else np.pi, turn)
    return _beside(plan, u, side * v, turn, kind, rng.integers(furniture.VARIANTS, size=count))


def _corner_signs(rng: np.random.Generator, plan: StreetPlan) -> np.ndarray:
    rows = [(s.u_m + way * (s.half_m + s.pavement_m * 0.6), plan.edge(side) + side * 0.7, 0.0, furniture.SIGN, 0)
            for s in plan.own_streets for side in s.sides for way in (-1, 1)]  # fmt: skip
    signs = np.array(rows, float).reshape(-1, 5)
    signs = signs[rng.random(len(signs)) < 0.6]
    signs[:, 2] = rng.integers(0, 4, len(signs)) * np.pi / 2
    signs[:, 4] = rng.integers(furniture.VARIANTS, size=len(signs))
    return signs


def _pole_offset(rng: np.random.Generator, pavement_m: float) -> float:
    """Return how far from the kerb poles stand: close to it, or at the back of the pavement."""
    return float(rng.choice([0.5, max(pavement_m - 0.25, 0.6)]) + rng.uniform(-0.1, 0.15))


def _beside(plan: StreetPlan, *columns: float | np.ndarray) -> np.ndarray:
    """Return rows of u, v and more without those in the mouths of side streets and below the bridge."""
    rows = rows_of(*columns)
    near_bridge = np.abs(rows[:, 0] - plan.bridge_u_m) < 14.0
    beyond = (rows[:, 0] > plan.stretch.half_m) | ~plan.goes_on(rows[:, 0])
    return rows[~(near_bridge | beyond) & (plan.in_side_street(rows[:, 0], rows[:, 1], 1.0) < 0)]


def parked(rng: np.random.Generator, plan: StreetPlan, town: Settlement) -> Placements:
    """Sample where vehicles park: along our kerbs, in side streets, and before houses."""
    placements = []
    for which, side in enumerate((-1, 1)):
        if plan.parked[which]:
            low, high = plan.stretch.span(92.0)
            at_most = 40 if plan.stretch is not Stretch.FURTHER else int((high - low) / 5.3)
            u = low + np.cumsum(rng.uniform(5.3, 7.2, at_most))
            u = u[(u < high) & (rng.random(at_most) < rng.uniform(*_PARKED_SHARE[plan.theme]))]
            v = side * (plan.edge_m[which] - rng.uniform(0.98, 1.08, len(u)))
            clear = (plan.in_side_street(u, v, 4.0) < 0) & plan.goes_on(u)
            turn = np.where(rng.random(len(u)) < 0.85, 0.0 if side < 0 else np.pi, np.pi if side < 0 else 0.0)
            placements.append(Placements.of(u, v, turn + rng.normal(0, 0.025, len(u))).select(clear))
    for street in plan.own_streets:
        for side in street.sides if street.half_m > 2.7 and plan.theme != "country" else ():
            flank = rng.choice([-1, 1])
            v = abs(plan.edge(side)) + 8.0 + np.cumsum(rng.uniform(5.4, 7.5, 11))
            v = side * v[(rng.random(11) < rng.uniform(*_PARKED_SHARE[plan.theme])) & (v < street.end_m - 4)]
            u = np.full(len(v), street.u_m + flank * (street.half_m - 1.0))
            turn = rng.choice([0.0, np.pi], len(v)) + rng.normal(0, 0.025, len(v))
            placements.append(Placements.of(u, v, turn, across=True))
    placements += [_court(rng, plan, town, side) for side in (-1, 1) if plan.court_m(side)]
    wide = town.gaps_m[(town.gaps_m[:, 1] - town.gaps_m[:, 0] > 3.2) & plan.stretch.keeps(town.gaps_m[:, 0], 70.0)]
    wide = wide[rng.random(len(wide)) < {"city": 0.2, "suburb": 0.45, "country": 0.2}[plan.theme]]
    u, side = wide[:, 0] + 1.7, wide[:, 2]
    v = side * (np.where(side > 0, plan.front(1), -plan.front(-1)) + rng.uniform(0.0, 5.0, len(wide)))
    turn = rng.choice([0.0, np.pi], len(wide)) + rng.normal(0, 0.04, len(wide))
    free = ~town.covers(u, v - 2.0, 0.9) & ~town.covers(u, v + 2.0, 0.9) & ~town.covers(u, v, 0.9)
    placements.append(Placements.of(u, v, turn, across=True, rise_m=plan.level_m[1]).select(free))
    return Placements.join(placements)


def _court(rng: np.random.Generator, plan: StreetPlan, town: Settlement, side: int) -> Placements:
    """Sample cars that stand side by side on a place before the houses, in one row or two with a way between."""
    kerb = plan.edge_m[(side + 1) // 2] + plan.pavement_m[(side + 1) // 2]
    rows = kerb + np.array([3.0, 14.0])[: 1 + (plan.court_m(side) > 16.5)]
    low, high = plan.stretch.span(60.0)
    u, v = (a.ravel() for a in np.meshgrid(np.arange(low + 2, high - 2, rng.uniform(2.6, 3.1)), rows))
    v = side * (v + rng.normal(0, 0.15, len(v)))
    keep = (rng.random(len(u)) < rng.uniform(*_PARKED_SHARE[plan.theme])) & (plan.in_side_street(u, v, 5.0) < 0)
    keep &= plan.goes_on(u) & ~town.covers(u, v, 2.6) & ~(np.abs(u - plan.bridge_u_m) < 18)
    turn = rng.choice([0.0, np.pi], len(u)) + rng.normal(0, 0.03, len(u))
    return Placements.of(u, v, turn, across=True, rise_m=plan.level_m[1]).select(keep)


def driving(rng: np.random.Generator, plan: StreetPlan, speed_m_s: float) -> Placements:
    """Sample who drives: ahead of us and behind at our speed, towards us, and away into side streets."""
    placements = []
    for ahead in (-1, 1):
        count = rng.poisson(_TRAFFIC[plan.theme] / 3)
        gap = _OUR_LENGTH_M + 0.6 * speed_m_s + rng.exponential(18.0, count)
        u = ahead * (np.cumsum(gap) + 3.0)
        placements.append(Placements.of(u, plan.our_v_m + rng.normal(0, 0.1, count), 0.0, speed_m_s))
    count = rng.poisson(_TRAFFIC[plan.theme] / 2)
    u = np.cumsum(_OUR_LENGTH_M + 4 + rng.exponential(25.0, count)) + rng.uniform(-80, 10)
    if plan.lanes == 1:  # the way is too narrow to meet: far ones only
        u = u[u > 30 + 5 * speed_m_s]
    fast = max(speed_m_s, 3.0) * rng.uniform(0.8, 1.2)
    if np.isfinite(plan.ends_m[0]):  # they would get there in our sight
        u = u[(u > 5) & (speed_m_s > 0)]
    side = plan.lane_m / 2 if plan.lanes == 2 else 0.0
    placements.append(Placements.of(u, side, np.pi, fast))
    placements += _outer_traffic(rng, plan, speed_m_s, fast)
    for street in plan.side_streets:
        if rng.random() < 0.2 and np.isinf(street.end_m):
            way = street.sides[0]
            turn = 0.0 if way > 0 else np.pi
            at = np.array([way * (abs(plan.edge(way)) + rng.uniform(6, 40))])
            placements.append(Placements.of(at * 0 + street.u_m, at, turn, rng.uniform(3, 9), across=True))
    every = Placements.join(placements)
    return every.select((np.abs(every.u_m) < 105) & (plan.goes_on(every.u_m) | every.across))


def _outer_traffic(
    rng: np.random.Generator, plan: StreetPlan, speed_m_s: float, oncoming_m_s: float
) -> list[Placements]:
    """Sample who drives in the outer lanes of a wide road: on our side as fast as we do, and never beside us."""
    placements = []
    for side in (-1, 1):
        for lane in range(plan.outer_lanes(side)):
            u = rng.uniform(-80, -40) + np.cumsum(_OUR_LENGTH_M + rng.exponential(_OUTER_GAP_M, 16))
            u = u[np.abs(u) > 7.0] if side < 0 else u
            if side > 0 and np.isfinite(plan.ends_m[0]):
                u = u[(u > 5) & (speed_m_s > 0)]
            v = side * plan.lane_m * (plan.lanes / 2 + 0.5 + lane)
            turn, fast = (0.0, speed_m_s) if side < 0 else (np.pi, oncoming_m_s)
            placements.append(Placements.of(u, v + rng.normal(0, 0.1, len(u)), turn, fast))
    return placements


def oncoming_speed_m_s(batches: Sequence[ObjectBatch]) -> float | None:
    """Return how fast those drive who come towards us; None where nobody does."""
    for places in (batch.placements for batch in batches if batch.leans):
        towards = ~places.across & (places.turn_rad == np.pi) & (places.speed_m_s > 0)
        if towards.any():
            return float(places.speed_m_s[towards][0])
    return None


def _oncoming(rng: np.random.Generator, plan: StreetPlan, speed_m_s: float) -> Placements:
    """Sample who comes towards us in a further stretch; on a single lane nobody does."""
    rate = _TRAFFIC[plan.theme] / 2 * plan.stretch.share(92.0) * (1 + speed_m_s / plan.speed_m_s)
    low, high = plan.stretch.span(92.0)
    met_at = low + np.cumsum(_MET_APART_M + rng.exponential((high - low) / rate, 40))
    met_at = met_at[(met_at < high) & (plan.lanes == 2)]
    return Placements.of(_met(plan, met_at, np.pi, speed_m_s), plan.lane_m / 2, np.pi, speed_m_s)


def _met(plan: StreetPlan, u_m: np.ndarray, turn_rad: float | np.ndarray, speed_m_s: float | np.ndarray) -> np.ndarray:
    """Return where those who move are at time 0 that our car meets at positions along the street."""
    return u_m - speed_m_s * np.cos(turn_rad) * u_m / plan.speed_m_s


def traffic(
    rng: np.random.Generator, plan: StreetPlan, town: Settlement, oncoming_m_s: float = 0.0, first_instance: int = 1
) -> list[ObjectBatch]:
    """Sample all vehicles, people and bicycles, each with an instance of its own.

    Those of later stretches move so that our car meets them there.

    Args:
        oncoming_m_s: speed of those who drive towards us in further stretches.
        first_instance: number of the first instance.
    """
    resting = parked(rng, plan, town)
    match plan.stretch:
        case Stretch.FIRST:
            going = driving(rng, plan, plan.speed_m_s)
        case Stretch.REST:
            going = Placements.of(np.zeros(0), 0.0)
        case Stretch.FURTHER:
            going = _oncoming(rng, plan, oncoming_m_s)
    placements = Placements.join([resting, going])
    kinds = np.concatenate(
        (sample_vehicle_kinds(rng, len(resting), large=0.0), sample_vehicle_kinds(rng, len(going), large=0.06))
    )
    kinds[placements.across] = HATCHBACK  # short drives and narrow streets
    groups = [make_vehicles(rng, kinds, placements, first_instance)]
    following = first_instance + len(placements)
    for sample, make in ((_walkers, make_walkers), (_riders, make_cyclists)):
        people = sample(rng, plan)
        if len(people):
            groups.append(make(rng, people, following))
        following += len(people)
    count = rng.poisson(1.2 * plan.stretch.share(40.0)) if plan.theme != "country" else 0
    side = rng.choice([-1, 1], count)
    v = np.where(side > 0, plan.front(1) - 0.5, plan.front(-1) + 0.5)
    bicycles = Placements.of(
        rng.uniform(*plan.stretch.span(40.0), count), v, rng.normal(0, 0.3, count), rise_m=plan.level_m[1]
    )
    clear = (plan.in_side_street(bicycles.u_m, bicycles.v_m, 2.0) < 0) & plan.goes_on(bicycles.u_m)
    if clear.any():
        groups.append(make_cyclists(rng, bicycles.select(clear), following, ridden=False))
    return groups


def _riders(rng: np.random.Generator, plan: StreetPlan) -> Placements:
    """Sample cyclists: before us at our speed, and towards us; in later stretches those who come towards us."""
    count = rng.poisson(_CYCLISTS[plan.theme] * plan.stretch.share(60.0))
    side = rng.choice([-1, 1], count)
    against_v_m = plan.edge_m[1] - 0.5 - 2.1 * plan.parked[1]
    slow = np.minimum(plan.speed_m_s, 5.0)
    if plan.stretch is not Stretch.FIRST:
        passes = against_v_m - plan.our_v_m > _PASSES_M
        u = rng.uniform(*plan.stretch.span(60.0), count)[(side > 0) & passes]
        return Placements.of(_met(plan, u, np.pi, slow + 1.0), against_v_m, np.pi, slow + 1.0)
    u = rng.uniform(8, 60, count) * rng.choice([-1, 1], count)
    v = np.where(side < 0, plan.our_v_m - 0.1, against_v_m)
    away = ((side > 0) | (u > 12)) & plan.goes_on(u)
    if np.isfinite(plan.ends_m[0]):
        away &= (side < 0) | (u > 0)
    speed_m_s = np.where(side < 0, plan.speed_m_s, slow + 1.0)
    return Placements.of(u, v, np.where(side < 0, 0.0, np.pi), speed_m_s).select(away)


def _walkers(rng: np.random.Generator, plan: StreetPlan) -> Placements:
    count = rng.poisson(_WALKERS[plan.theme] * plan.stretch.share_around(28.0))
    side = rng.choice([-1, 1], count)
    edge_m, pavement_m = np.where(side > 0, *plan.edge_m[::-1]), np.where(side > 0, *plan.pavement_m[::-1])
    across = edge_m + pavement_m * rng.uniform(0.3, 0.9, count)
    speed = np.where(rng.random(count) < 0.75, rng.uniform(0.7, 1.8, count), 0.0)
    u = plan.stretch.around(rng, 28.0, count)
    if plan.stretch is Stretch.FIRST:
        u = np.clip(u, -80, 80)
    keep = (plan.in_side_street(u, side * across, 1.0) < 0) & plan.goes_on(u)
    turn = rng.choice([0.0, np.pi], count)
    if plan.stretch is not Stretch.FIRST:
        speed = np.minimum(speed, _SLOWER * plan.speed_m_s)
        u = _met(plan, u, turn, speed)
    return Placements.of(u, side * across, turn, speed, rise_m=plan.level_m[0]).select(keep)
