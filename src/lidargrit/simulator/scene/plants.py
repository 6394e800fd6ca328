"""Trees, bushes and hedges: kept shapes of trunks, limbs and small leaves that let beams through; places → objects."""

from functools import cache

import numpy as np
from jaxtyping import Float, Num

from lidargrit.scans import classes
from lidargrit.simulator import materials
from lidargrit.simulator.mesh import Shape
from lidargrit.simulator.scene.objects import ObjectBatch, Placements
from lidargrit.simulator.scene.shapes import ShapeBuilder, boxes, leaves, owners, sweep
from lidargrit.simulator.scene.street_plan import StreetPlan

TREES, BUSHES, HEDGES, THICKETS = 30, 20, 6, 8  # shapes of each
THICKET_M = 16.0  # length of a piece
_TRUNK, _LIMBS, _LEAVES = range(3)
_MATERIALS = (materials.BARK, materials.BARK, materials.LEAVES)
_LABELS = (classes.TRUNK, classes.VEGETATION, classes.VEGETATION)
_HEDGE_M = np.array([5.0, 0.9, 1.4])  # of the shapes: pieces that overlap a little
# Height, its part below the crown, half the width of the crown, leaves; a round, a high, a slim, a small one, a fir.
_HABITS = ((9.5, 0.30, 3.2, 3400), (12.0, 0.28, 3.0, 3800), (13.0, 0.10, 1.4, 3000), (5.5, 0.36, 1.7, 2200),
           (11.0, 0.06, 2.3, 3600))  # fmt: skip
_FIR = 4


def _ball(rng: np.random.Generator, count: int) -> Float[np.ndarray, "n 3"]:
    """Return positions in a unit ball, denser at its surface."""
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return way * rng.random((count, 1)) ** 0.45


@cache
def tree_shapes(variant: int) -> tuple[Shape, Shape]:
    """Return one tree, made once, from its own seed: its trunk, and limbs with a tuft of leaves around each end.

    Many rays pass below a crown; in two shapes they are cast at the trunk alone.
    """
    rng, builder = np.random.default_rng((74, variant)), ShapeBuilder(*_MATERIALS)
    stem = ShapeBuilder(*_MATERIALS)
    habit = variant % len(_HABITS)
    tall, bare, wide, number = np.array(_HABITS[habit]) * rng.uniform(0.85, 1.15, 4)
    foot = bare * tall
    thick = tall * rng.uniform(0.009, 0.016)
    share = np.linspace(0, 1, 7)
    bend = np.cumsum(rng.normal(0, 0.03, (7, 2)), axis=0) * share[:, None]
    high = 0.95 if habit in (2, _FIR) else 0.62
    spine = np.column_stack((bend * tall * 0.12, -0.3 + (high * tall + 0.3) * share))
    radius = thick * (1.25 - 0.9 * share)
    radius[0] *= 1.3
    stem.add(_TRUNK, sweep(spine, radius, 10))
    count = 36 if habit == _FIR else 22
    level = np.sort(rng.uniform(0.0, 1.0, count))
    way = np.arange(count) * 2.399963 + rng.normal(0, 0.3, count)
    if habit == _FIR:
        reach, rise = wide * (1.05 - level) * rng.uniform(0.6, 0.95, count), rng.uniform(-0.6, -0.1, count)
        start_m = foot + (tall * 0.97 - foot) * level
        size = np.column_stack((np.maximum(0.5 * reach, 0.25),) * 2 + (np.full(count, 0.35),))
    else:
        outline = np.sqrt(np.maximum(1 - (2 * level - 0.9) ** 2 / 1.25, 0.1))
        reach, rise = wide * outline * rng.uniform(0.35, 0.75, count), (0.1 + 0.25 * level) * wide
        start_m = foot * 0.95 + (high * tall - foot) * level * 0.95
        tuft = (0.3, 0.48) if habit in (0, 3) else (0.42, 0.62)
        size = wide * rng.uniform(*tuft, (count, 1)) * np.array([1.0, 1.0, 0.9])
    core = np.column_stack([np.interp(start_m, spine[:, 2], spine[:, axis]) for axis in (0, 1)])
    start = np.column_stack((core, start_m))
    lift = np.where(np.full(count, habit == _FIR), rise, rise + (tall - high * tall) * level**1.5 * 0.9)
    tip = start + np.column_stack((reach * np.cos(way), reach * np.sin(way), lift))
    for a, b in zip(start, tip, strict=True):
        elbow = a + 0.5 * (b - a) + np.array([0, 0, 0.08 * (b - a)[2]])
        builder.add(_LIMBS, sweep(np.stack((a, elbow, b)), thick * np.array([0.42, 0.28, 0.1]), 5))
    volume = size.prod(axis=1) ** (2 / 3)
    home = rng.choice(count, int(number), p=volume / volume.sum())
    centre = tip[home] + _ball(rng, len(home)) * size[home]
    centre[:, 2] = np.maximum(centre[:, 2], foot * 0.8)
    face = np.pi * wide * (tall - foot) / 2 * (0.55 if habit == _FIR else 1.0)
    leaf = np.sqrt(rng.uniform(1.7, 2.8) * face / (0.65 * number))
    builder.add(_LEAVES, leaves(centre, leaf * rng.uniform(0.75, 1.25, len(home))))
    return stem.build(), builder.build()


@cache
def bush_shape(variant: int) -> Shape:
    """Return one bush about a metre high and wide, whose leaves begin at the ground; made once, from its own seed."""
    rng, builder = np.random.default_rng((75, variant)), ShapeBuilder(*_MATERIALS)
    count, number = int(rng.integers(5, 12)), 1100
    middle = _ball(rng, count) * np.array([0.42, 0.42, 0.36]) + np.array([0, 0, 0.42])
    size = rng.uniform(0.24, 0.42, (count, 1)) * np.array([1, 1, 0.9])
    home = rng.integers(0, count, number)
    centre = middle[home] + _ball(rng, number) * size[home]
    centre[:, 2] = np.abs(centre[:, 2])
    builder.add(_LEAVES, leaves(centre, rng.uniform(0.05, 0.085, number)))
    for end in middle:
        builder.add(_LIMBS, sweep(np.stack(([0, 0, -0.1], end * [0.4, 0.4, 0.7], end)), np.array([0.025, 0.018, 0.01]),
                                  4))  # fmt: skip
    return builder.build()


@cache
def hedge_shape(variant: int) -> Shape:
    """Return a piece of a cut hedge, dense in its heart, with leaves that stand out a hand; made once."""
    rng, builder = np.random.default_rng((76, variant)), ShapeBuilder(*_MATERIALS)
    half = _HEDGE_M * np.array([0.5, 0.5, 1.0])
    builder.add(_LEAVES, boxes(np.array([-half[0], -half[1] + 0.13, -0.3]), half - np.array([0.0, 0.13, 0.13])))
    number = 2600
    point = rng.uniform(-1, 1, (number, 3))
    face = rng.choice(3, number, p=[0.32, 0.32, 0.36])
    point[face == 0, 1], point[face == 1, 1], point[face == 2, 2] = -1, 1, 1
    point *= half * np.array([1, 1, 0.5])
    point[:, 2] += half[2] / 2
    wave = sum(np.sin(point @ rng.normal(0, 3.0, 3) + rng.uniform(0, 6)) for _ in range(4)) / 4
    inward = np.abs(rng.normal(0, 0.03, number)) + 0.05 - 0.05 * wave
    side = face < 2
    point[side, 1] -= np.sign(point[side, 1]) * inward[side]
    point[~side, 2] -= inward[~side]
    builder.add(_LEAVES, leaves(point, rng.uniform(0.05, 0.1, number)))
    return builder.build()


@cache
def thicket_shape(variant: int) -> Shape:
    """Return a piece of a wood's edge seen from afar: leaves from the ground to 8 m, with a dense heart; made once."""
    rng, builder = np.random.default_rng((77, variant)), ShapeBuilder(*_MATERIALS)
    number, half = 2200, THICKET_M / 2
    along = np.linspace(-half, half, 9)
    top = np.clip(8.0 + np.cumsum(rng.normal(0, 1.2, 9)) - 1.5 * (np.abs(along) > 0.9 * half), 4.5, 10.5)
    x = rng.uniform(-half, half, number)
    high = np.interp(x, along, top)
    z = high * rng.random(number) ** 0.8
    bulge = np.sqrt(np.maximum(1 - (z / high) ** 2, 0.05)) * (1 + 0.3 * np.sin(1.3 * x + rng.uniform(0, 6)))
    centre = np.column_stack((x, 2.4 * bulge * rng.choice([-1, 1], number) * rng.random(number) ** 0.4, z))
    builder.add(_LEAVES, leaves(centre, rng.uniform(0.2, 0.42, number)))
    low = np.minimum(top[1:], top[:-1]) * rng.uniform(0.35, 0.7, 8)
    heart = boxes(np.column_stack((along[:-1], np.full((8, 2), (-0.7, -0.5)))), np.column_stack(
        (along[1:], np.full(8, 0.7), low)))  # fmt: skip
    builder.add(_LEAVES, heart)
    return builder.build()


def _batch(
    rng: np.random.Generator, shapes: list[Shape], size: np.ndarray, green: np.ndarray, placements: Placements
) -> ObjectBatch:
    bark = rng.uniform(0.2, 0.4, len(shapes))
    return ObjectBatch.standing(shapes, size, np.column_stack((bark, bark, green)), _LABELS, placements)


def make_trees(
    rng: np.random.Generator, plan: StreetPlan, u_m: Num[np.ndarray, " n"], v_m: Num[np.ndarray, " n"],
    size: float = 1.0, rise_m: float = 0.0,
) -> list[ObjectBatch]:  # fmt: skip
    """Sample trees, trunks and crowns apart; ``size`` 1 is a street of trees of about 10 m.

    Near the road none has low branches.
    """
    count = len(u_m)
    over_road = np.abs(v_m) < max(plan.edge_m) + 4.5
    variant = rng.integers(0, TREES, count)
    spread = variant % len(_HABITS)
    variant = np.where(over_road & ((spread == 2) | (spread == _FIR)), variant - spread + rng.integers(0, 2), variant)
    grown = size * rng.uniform(0.7, 1.35, count)
    # The lowest leaves of a tree beside the road hang higher than a car, at a quarter of its height or more.
    upwards = grown * np.where(over_road, np.maximum(1.0, 3.2 / np.maximum(2.4 * grown, 1.0)), 1.0)
    stretch = np.column_stack((grown, grown * rng.uniform(0.9, 1.1, count), upwards))
    placements = Placements.of(u_m, v_m, rng.uniform(0, 2 * np.pi, count), rise_m=rise_m)
    shapes, green = [tree_shapes(int(v)) for v in variant], rng.uniform(0.3, 0.6, count)
    return [_batch(rng, [pair[part] for pair in shapes], stretch, green, placements) for part in (0, 1)]


def make_bushes(
    rng: np.random.Generator, u_m: Num[np.ndarray, " n"], v_m: Num[np.ndarray, " n"], rise_m: float = 0.0
) -> ObjectBatch:
    """Sample bushes, most of them lower than a metre and a half."""
    count = len(u_m)
    wide = rng.uniform(0.6, 2.4, count)
    high = np.where(rng.random(count) < 0.2, rng.uniform(1.5, 3.0, count), wide * rng.uniform(0.5, 0.9, count))
    stretch = np.column_stack((wide, wide * rng.uniform(0.8, 1.2, count), high))
    placements = Placements.of(u_m, v_m, rng.uniform(0, 2 * np.pi, count), rise_m=rise_m)
    shapes = [bush_shape(int(v)) for v in rng.integers(0, BUSHES, count)]
    return _batch(rng, shapes, stretch, rng.uniform(0.3, 0.6, count), placements)


def make_hedges(
    rng: np.random.Generator,
    u_m: Float[np.ndarray, "n 2"],
    v_m: Float[np.ndarray, "n 2"],
    height_m: Float[np.ndarray, " n"],
    rise_m: float = 0.0,
) -> ObjectBatch:
    """Make cut hedges that fill boxes of the street, each as several pieces along it."""
    length = u_m[:, 1] - u_m[:, 0]
    pieces = np.maximum(np.ceil(length / 5.5), 1).astype(int)
    home, order = owners(pieces)
    step = (length / pieces)[home]
    green = rng.uniform(0.3, 0.6, len(length))
    size = np.column_stack((step + 0.1, np.abs(v_m[home, 1] - v_m[home, 0]), height_m[home])) / _HEDGE_M
    turn = rng.integers(0, 2, len(home)) * np.pi
    placements = Placements.of(u_m[home, 0] + (order + 0.5) * step, v_m[home].mean(axis=1), turn, rise_m=rise_m)
    return _batch(rng, [hedge_shape(int(v)) for v in rng.integers(0, HEDGES, len(home))], size, green[home], placements)


def make_thickets(
    rng: np.random.Generator, u_m: Num[np.ndarray, " n"], v_m: Num[np.ndarray, " n"],
    turn_rad: float | Num[np.ndarray, " n"], rise_m: float = 0.0,
) -> ObjectBatch:  # fmt: skip
    """Sample pieces of the edges of woods, 13 to 20 m long."""
    count = len(u_m)
    size = np.column_stack((rng.uniform(0.8, 1.25, count), rng.uniform(0.7, 1.5, count), rng.uniform(0.7, 1.4, count)))
    placements = Placements.of(u_m, v_m, turn_rad, rise_m=rise_m)
    shapes = [thicket_shape(int(v)) for v in rng.integers(0, THICKETS, count)]
    return _batch(rng, shapes, size, rng.uniform(0.3, 0.6, count), placements)
