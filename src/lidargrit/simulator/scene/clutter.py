"""What fills a city's pavements: random numbers and a plan → building sites, railings, stalls, boxes, beds, racks."""

import numpy as np
from jaxtyping import Float, Num

from lidargrit.simulator.scene.furniture import (
    BED,
    BOX,
    HOARDING,
    HOARDING_M,
    RACK,
    RAILING,
    RAILING_M,
    SCAFFOLD,
    SCAFFOLD_M,
    STALL,
    VARIANTS,
    make_furniture,
)
from lidargrit.simulator.scene.objects import ObjectBatch, Placements
from lidargrit.simulator.scene.shapes import rows_of
from lidargrit.simulator.scene.street_plan import StreetPlan

# Drawn once a street. Of two labelled streets of PandaSet 13 and 27 % of the points are on things, walls and fences; of
# a suburb of KITTI 1.6 %.
_BUSY = {"city": 1.0, "suburb": 0.12, "country": 0.0}
_BUSY_SPREAD = 0.7  # of its natural log
_SINGLES = 7.0  # on each pavement of a busy street
_SINGLE_SHARES = {STALL: 0.14, BOX: 0.36, BED: 0.32, RACK: 0.18}
_ROW_CHANCE = {HOARDING: 0.28, SCAFFOLD: 0.25, RAILING: 0.25}  # on each side of a busy street
_ROW_M = (10.0, 60.0)
_TO_M = 70.0  # what stands farther away hides behind the rest


def clutter(rng: np.random.Generator, plan: StreetPlan) -> ObjectBatch:
    """Set what stands on pavements besides lamps and signs; a street has much or little of it."""
    busy = _BUSY[plan.theme] * float(np.exp(_BUSY_SPREAD * rng.standard_normal()))
    rows = [np.zeros((0, 5))]  # columns: u, v, turn, kind, variant
    for which, side in enumerate((-1, 1)):
        pavement = plan.pavement_m[which]
        if not busy or pavement < 1.5:
            continue
        kerb, back = plan.edge_m[which] + 0.3, plan.edge_m[which] + pavement
        facing = 0.0 if side > 0 else np.pi  # what opens along -y opens to the road
        rows.append(_row(rng, plan, busy, HOARDING, HOARDING_M, side * (back - 0.4), facing))
        rows.append(_row(rng, plan, busy, SCAFFOLD, SCAFFOLD_M, plan.front(side) - side * 0.75, facing))
        rows.append(_row(rng, plan, busy, RAILING, RAILING_M, side * kerb, facing))
        count = rng.poisson(min(busy, 2.5) * _SINGLES * plan.stretch.share(_TO_M))
        kind = rng.choice(list(_SINGLE_SHARES), count, p=list(_SINGLE_SHARES.values()))
        v = np.where((kind == RACK) & (rng.random(count) < 0.5), kerb + 0.4, back - rng.uniform(0.2, 0.6, count))
        u = rng.uniform(*plan.stretch.span(_TO_M), count)
        turn = np.where(kind == RACK, np.pi / 2, facing)
        rows.append(rows_of(u, side * v, turn, kind, rng.integers(VARIANTS, size=count)))
    every = np.concatenate(rows)
    u, v, turn, kind, variant = every[_clear(plan, every[:, 0], every[:, 1])].T
    placements = Placements.of(u, v, turn, rise_m=plan.level_m[0])
    return make_furniture(rng, kind.astype(int), variant.astype(int), placements)


def _row(
    rng: np.random.Generator, plan: StreetPlan, busy: float, kind: int, piece_m: float, v_m: float, turn_rad: float
) -> Float[np.ndarray, "n 5"]:
    """Sample one row of pieces along the street, or none."""
    low, high = plan.stretch.span(_TO_M)
    count = int(rng.uniform(*_ROW_M) / piece_m)
    first, variant = rng.uniform(low, max(high - count * piece_m, low + 1)), int(rng.integers(VARIANTS))
    if rng.random() > busy * _ROW_CHANCE[kind]:
        return np.zeros((0, 5))
    u = first + piece_m * np.arange(count)
    return rows_of(u[u < high], v_m, turn_rad, kind, variant)


def _clear(plan: StreetPlan, u_m: Num[np.ndarray, " n"], v_m: Num[np.ndarray, " n"]) -> np.ndarray:
    """Return which places are clear of side streets, of the bridge, and of the end of the stretch or road."""
    return (
        (plan.in_side_street(u_m, v_m, 3.0) < 0)
        & plan.goes_on(u_m)
        & (np.abs(u_m - plan.bridge_u_m) > 14.0)
        & (u_m < plan.stretch.half_m - HOARDING_M / 2)
    )
