"""Trees, bushes and hedges: positions and sizes → trunks and crowns of many small leaves that let beams through."""

import numpy as np
from jaxtyping import Float, Num

from lidargrit.scans import classes
from lidargrit.simulator import materials
from lidargrit.simulator.scene.buildings import Houses
from lidargrit.simulator.scene.shapes import MeshBuilder, leaves, owners, rows_of, tubes
from lidargrit.simulator.scene.street_plan import StreetPlan

_LEAVES = 30_000  # in one go at most: denser woods have fewer and larger leaves
_LIMBS_TO_M = 30.0  # limbs farther away are thinner than a beam, and lost in leaves
_BLOBS = 7  # round tufts that make up a crown


def _points_in_tuft(count: int = 4096) -> np.ndarray:
    """Return positions in a ball, denser at its surface, from which those of all leaves are sampled."""
    rng = np.random.default_rng(0)
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return (way * 0.42 * rng.random((count, 1)) ** 0.45).astype(np.float32)


_TUFT = _points_in_tuft()


def _leaf_m(away_m: np.ndarray) -> np.ndarray:
    """Return the radius of leaves, or tufts of them: small where beams lie close, and not smaller than beams later."""
    return np.maximum(np.clip(0.1 + 0.0045 * away_m, 0.14, 0.5), np.minimum(0.163 + 0.01 * (away_m - 14.0), 0.75))


def add_trees(
    builder: MeshBuilder, rng: np.random.Generator, plan: StreetPlan, houses: Houses, u_m: Num[np.ndarray, " n"],
    v_m: Num[np.ndarray, " n"], size: float = 1.0, rise_m: float = 0.0,
) -> None:  # fmt: skip
    """Add trees with a clear trunk, forked below the crown; ``size`` 1 is a street tree of about 8 m."""
    count = len(u_m)
    if not count:
        return
    foot = plan.ground_points(u_m, v_m) + np.array([0, 0, rise_m])
    tall = size * rng.uniform(5.0, 11.0, count)
    over_road = np.abs(v_m) < max(plan.edge_m) + 4.5  # no branches as low as our own car
    clear = np.clip(tall * rng.uniform(0.1, 0.36, count), np.where(over_road, 2.5, 0.5), 4.0)
    wide = np.minimum(size * rng.uniform(1.2, 3.2, count), (tall - clear) * 0.75)
    trunk = np.clip(tall * rng.uniform(0.009, 0.022, count), 0.05, 0.3)
    fork = clear + 0.25 * (tall - clear)
    lean = rng.normal(0, 0.02, (count, 2)) * fork[:, None]
    top = foot + np.column_stack((lean, fork))
    bark = rng.uniform(0.2, 0.4, (count, 1))
    away = houses.nearest_approach_m(plan, foot)
    near = away < _LIMBS_TO_M
    for some, sides in ((near, 7), (~near, 4)):
        stems = tubes((foot - np.array([0, 0, 0.3]))[some], top[some], trunk[some] * 1.15, trunk[some] * 0.75, sides)
        builder.add(
            stems[:, : 2 * sides], materials.BARK, bark[some], classes.TRUNK
        )  # nobody sees the cap in the crown
    limb = np.repeat(np.flatnonzero(near), 4)
    way = rng.uniform(0, 2 * np.pi, len(limb))
    reach = wide[limb] * rng.uniform(0.4, 0.8, len(limb))
    rise = (tall - fork)[limb] * rng.uniform(0.3, 0.7, len(limb))
    tip = top[limb] + rows_of(reach * np.cos(way), reach * np.sin(way), rise)
    start = foot[limb] + (top - foot)[limb] * rng.uniform(0.75, 1.0, (len(limb), 1))
    builder.add(tubes(start, tip, trunk[limb] * 0.5, 0.02, sides=4), materials.BARK, bark[limb], classes.VEGETATION)
    middle = foot + np.column_stack((lean, (clear + tall) / 2))
    _add_crowns(builder, rng, middle, wide, (tall - clear) / 2, away, density=1.0)


def add_bushes(
    builder: MeshBuilder, rng: np.random.Generator, plan: StreetPlan, houses: Houses, u_m: Num[np.ndarray, " n"],
    v_m: Num[np.ndarray, " n"], rise_m: float = 0.0,
) -> None:  # fmt: skip
    """Add bushes and conifers whose leaves begin at the ground."""
    count = len(u_m)
    if not count:
        return
    foot = plan.ground_points(u_m, v_m) + np.array([0, 0, rise_m])
    wide = rng.uniform(0.4, 1.8, count)
    half = np.where(rng.random(count) < 0.25, rng.uniform(1.2, 2.6, count), wide * rng.uniform(0.6, 1.1, count))
    _add_crowns(
        builder,
        rng,
        foot + rows_of(0.0, 0.0, half * 0.9),
        wide,
        half,
        houses.nearest_approach_m(plan, foot),
        density=1.6,
    )


def _add_crowns(
    builder: MeshBuilder,
    rng: np.random.Generator,
    middle: np.ndarray,
    wide: np.ndarray,
    half: np.ndarray,
    away: np.ndarray,
    density: float,
) -> None:
    """Fill round tufts within ellipsoids with leaves; far crowns have fewer and larger ones."""
    count = len(middle)
    leaf = np.minimum(_leaf_m(away), 0.5 * np.minimum(wide, half)) * rng.uniform(0.85, 1.25, count)
    face = np.pi * wide * half  # of the crown from the side
    thick = density * rng.uniform(0.8, 2.2, count)  # leaves one behind another
    number = np.clip(thick * face / (0.65 * leaf**2), 12, 1100)
    spared = np.minimum(1.0, _LEAVES / max(number.sum(), 1.0))
    number, leaf = (number * spared).astype(int), leaf / np.sqrt(spared)
    out = rng.normal(size=(count, _BLOBS, 3))
    out /= np.linalg.norm(out, axis=2, keepdims=True) + 1e-9
    scale = rows_of(wide, wide, half)
    tuft = middle[:, None] + out * rng.uniform(0.3, 0.68, (count, _BLOBS, 1)) * scale[:, None]
    home = owners(number)
    pick = home * _BLOBS + rng.integers(0, _BLOBS, len(home))
    within = _TUFT[rng.integers(0, len(_TUFT), len(home))]
    centre = tuft.reshape(-1, 3).astype(np.float32)[pick] + within * scale.astype(np.float32)[home]
    green = rng.uniform(0.3, 0.6, count)
    builder.add(leaves(centre, leaf[home]), materials.LEAVES, green[home], classes.VEGETATION)


def add_hedges(
    builder: MeshBuilder,
    rng: np.random.Generator,
    plan: StreetPlan,
    u_m: Float[np.ndarray, "n 2"],
    v_m: Float[np.ndarray, "n 2"],
    height_m: Float[np.ndarray, " n"],
    rise_m: float = 0.0,
) -> None:
    """Add cut hedges in boxes of the street: a dense heart a hand below the surface, and leaves all over."""
    if not len(u_m):
        return
    low_u, low_v = u_m.min(axis=1) + 0.12, v_m.min(axis=1) + 0.12
    high_u, high_v = u_m.max(axis=1) - 0.12, v_m.max(axis=1) - 0.12
    heart = plan.blocks(low_u, high_u, low_v, high_v, -0.3, rise_m + height_m - 0.12)
    green = rng.uniform(0.3, 0.6, len(u_m))
    builder.add(heart, materials.LEAVES, green[:, None] * 0.8, classes.VEGETATION)
    size = rows_of(high_u - low_u, high_v - low_v, height_m) + np.array([0.24, 0.24, 0])
    middle = rows_of((low_u + high_u) / 2, (low_v + high_v) / 2, height_m / 2)
    leaf = np.minimum(0.9 * _leaf_m(plan.nearest_approach_m(plan.ground_points(middle[:, 0], middle[:, 1]))), 0.35)
    skin = size[:, 2] * (size[:, 0] + size[:, 1]) * 2 + size[:, 0] * size[:, 1]
    number = np.clip(0.45 * skin / leaf**2, 20, 900).astype(int)
    home = owners(number)
    inside = rng.random((len(home), 3)) - 0.5
    # Leaves move to a face: to the long sides and the top more often than to the ends, by their areas.
    area = np.column_stack((size[:, 1] * size[:, 2] * 2, size[:, 0] * size[:, 2] * 2, size[:, 0] * size[:, 1]))
    share = np.cumsum(area / area.sum(axis=1, keepdims=True), axis=1)[home]
    chance = rng.random(len(home))
    axis = (chance[:, None] > share[:, :2]).sum(axis=1)
    side = np.where(axis == 2, 0.5, np.where(inside[np.arange(len(home)), axis] > 0, 0.5, -0.5))
    deep = 0.12 * rng.random(len(home)) / size[home, axis]
    inside[np.arange(len(home)), axis] = side - np.sign(side) * deep
    at_m = middle[home] + inside * size[home]
    corners = plan.ground_points(
        np.stack((low_u, high_u, low_u, high_u), axis=1), np.stack((low_v, low_v, high_v, high_v), axis=1)
    )
    du, dv = (
        (at_m[:, 0] - low_u[home]) / (high_u - low_u)[home],
        (at_m[:, 1] - low_v[home]) / (high_v - low_v)[home],
    )
    shares = np.stack(((1 - du) * (1 - dv), du * (1 - dv), (1 - du) * dv, du * dv), axis=1)
    centre = np.einsum("nk,nkc->nc", shares, corners[home])  # hedges are straight: no need to bend every leaf
    centre[:, 2] += at_m[:, 2] + rise_m
    builder.add(leaves(centre, leaf[home]), materials.LEAVES, green[home], classes.VEGETATION)
