"""Positions of trees, bushes and woods: a plan and its houses → what is green beside a road."""

import numpy as np

from lidargrit.simulator.scene.objects import ObjectBatch
from lidargrit.simulator.scene.plants import THICKET_M, make_bushes, make_thickets, make_trees
from lidargrit.simulator.scene.settlement import Settlement, from_road_m
from lidargrit.simulator.scene.shapes import rows_of
from lidargrit.simulator.scene.street_plan import StreetPlan
from lidargrit.simulator.scene.stretches import EXTENT_M, Stretch


def greenery(rng: np.random.Generator, plan: StreetPlan, town: Settlement) -> list[ObjectBatch]:
    """Plant trees and bushes: along pavements, in gardens and parks, and in rows and woods in the country."""
    green = rng.uniform(0.3, 1.0)
    lots = [*_parks(rng, town), *(_woods(rng, plan.stretch) if plan.theme == "country" else [])]
    usual = {"city": 90, "suburb": 160, "country": 60}[plan.theme]
    count = rng.poisson(usual * green * plan.stretch.share_around(55.0))
    lots.append(np.column_stack((plan.stretch.around(rng, 55.0, count), rng.normal(0, 45, count))))
    trees = [_plantable(plan, town, np.concatenate(lots), 2.2), *_tree_rows(rng, plan)]
    u, v = _clear_of_bridge(plan, *np.concatenate(trees).T)
    wood = make_trees(rng, plan, u, v, size=rng.uniform(0.8, 1.3), rise_m=plan.level_m[1])
    usual = {"city": 45, "suburb": 170, "country": 60}[plan.theme]
    count = rng.poisson(usual * green * plan.stretch.share_around(35.0))
    points = [np.column_stack((plan.stretch.around(rng, 35.0, count), rng.normal(0, 18, count))), *_parks(rng, town)]
    u, v = _clear_of_bridge(plan, *_plantable(plan, town, np.concatenate(points), 1.0).T)
    return [*wood, make_bushes(rng, u, v, plan.level_m[1]), *_thickets(rng, plan, town)]


def _thickets(rng: np.random.Generator, plan: StreetPlan, town: Settlement) -> list[ObjectBatch]:
    """Close the view behind houses and fields with the edges of woods; some streets stay open."""
    if plan.stretch is Stretch.REST:  # which the first stretch has closed already
        return []
    half, pieces = plan.stretch.half_m, []  # columns: u, v, turn
    if plan.theme == "country":
        step, closed = THICKET_M * 0.95, rng.uniform(0.3, 1.2)
        for side in (-1, 1):
            if rng.random() < closed:
                row = np.arange(-half, half, step)
                pieces.append(rows_of(row, side * (rng.uniform(28, 65) + 6.0 * np.sin(row / rng.uniform(15, 40))), 0.0))
            for end in (-1, 1):
                if rng.random() < closed:
                    row = np.arange(rng.uniform(10, 25), 90, step)
                    pieces.append(rows_of(end * rng.uniform(30, 62) + 0 * row, side * row, np.pi / 2))
    count = rng.poisson({"city": 16, "suburb": 36, "country": 8}[plan.theme] * rng.uniform(0.2, 1.0) * half / EXTENT_M)
    pieces.append(rows_of(rng.uniform(-half, half, count), rng.choice([-1, 1], count) * rng.uniform(22, 75, count),
                          rng.choice([0, np.pi / 2], count)))  # fmt: skip
    rows = np.concatenate(pieces)
    u, v, across = rows[:, 0], rows[:, 1], rows[:, 2] > 0
    reach = THICKET_M * 0.6
    beside = np.where(across, 3.0, reach)
    free = (plan.in_side_street(u, v, beside + 2.0) < 0) & ~town.covers(u, v, 4.0) & (np.abs(u) < half - beside)
    free &= from_road_m(plan, u, v) > plan.farthest_front_m + reach
    if np.isfinite(plan.bridge_u_m):
        free &= np.abs(u - plan.bridge_u_m) > 16 + beside
    u, v, turn = rows[free].T
    return [make_thickets(rng, u, v, turn, plan.level_m[1])]


def _plantable(plan: StreetPlan, town: Settlement, points: np.ndarray, spare_m: float) -> np.ndarray:
    """Return the points (n, 2) that lie off roads and houses, and within the sensor's reach."""
    u, v = points.T
    keep = _off_road(plan, u, v, spare_m) & ~town.covers(u, v, 0.5 * spare_m)
    keep &= (np.hypot(u, v) if plan.stretch is Stretch.FIRST else np.abs(v)) < 115
    return points[keep]


def _parks(rng: np.random.Generator, town: Settlement) -> list[np.ndarray]:
    """Sample positions in the stretches without houses, denser near the road."""
    lots = []
    for u_from, u_to, side in town.parks_m:
        count = rng.poisson((u_to - u_from) * rng.uniform(0.1, 0.5))
        away = 4.0 + 45.0 * rng.random(count) ** 1.5
        lots.append(np.column_stack((rng.uniform(u_from, u_to, count), side * away)))
    return lots


def _woods(rng: np.random.Generator, stretch: Stretch) -> list[np.ndarray]:
    """Sample clumps of trees, and long rows of them that bound fields."""
    lots = []
    for _ in range(rng.poisson(2.5 * stretch.share_around(55.0))):
        count = rng.integers(12, 36)
        middle = stretch.around(rng, 55.0, 1)[0], rng.choice([-1, 1]) * rng.uniform(18, 80)
        lots.append(np.column_stack((rng.normal(middle[0], 14, count), rng.normal(middle[1], 8, count))))
    for side in (-1, 1):
        row = np.arange(*stretch.span(110.0), rng.uniform(3.0, 6.0))
        lots.append(np.column_stack((row, side * rng.uniform(35, 85) + rng.normal(0, 2.0, len(row)))))
    for _ in range(2):
        column = np.arange(20.0, 110.0, rng.uniform(3.0, 6.0)) * rng.choice([-1, 1])
        lots.append(np.column_stack((stretch.around(rng, 60.0, 1) + rng.normal(0, 2.0, len(column)), column)))
    return lots


def _tree_rows(rng: np.random.Generator, plan: StreetPlan) -> list[np.ndarray]:
    """Sample rows of trees along our road."""
    rows = []
    for which, side in enumerate((-1, 1)):
        wide = plan.theme == "country" or plan.pavement_m[which] > 1.8
        if not wide or rng.random() > {"city": 0.45, "suburb": 0.35, "country": 0.4}[plan.theme]:
            continue
        row = np.arange(*plan.stretch.span(90.0), rng.uniform(7, 16)) + rng.uniform(-3, 3)
        away = plan.edge_m[which] + (0.9 if plan.theme != "country" else rng.uniform(2.0, 5.0))
        row = row[(plan.in_side_street(row, row * 0 + side * away, 2.5) < 0) & (rng.random(len(row)) < 0.85)]
        row = row[plan.goes_on(row)]
        rows.append(np.column_stack((row, np.full(len(row), side * away))))
    return rows


def _off_road(plan: StreetPlan, u: np.ndarray, v: np.ndarray, spare_m: float) -> np.ndarray:
    """Return which points are clear of roads and pavements."""
    right, left = (
        plan.edge_m[which] + plan.pavement_m[which] + plan.court_m(side) for which, side in ((0, -1), (1, 1))
    )
    edge = np.where(v > 0, left, right)
    pavement = max((s.pavement_m for s in plan.side_streets), default=0.0)
    return (np.abs(v) > edge + spare_m * 0.6) & (plan.in_side_street(u, v, pavement + spare_m * 0.6) < 0)


def _clear_of_bridge(plan: StreetPlan, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    keep = np.abs(u - plan.bridge_u_m) > 14.0 if np.isfinite(plan.bridge_u_m) else np.ones(len(u), bool)
    return u[keep], v[keep]
