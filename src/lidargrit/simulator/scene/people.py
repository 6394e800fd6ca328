"""People on foot and on bicycles: poses → kept shapes of round limbs; places → objects of these shapes."""

from functools import cache

import numpy as np

from lidargrit.scans import classes
from lidargrit.simulator import materials
from lidargrit.simulator.mesh import Shape
from lidargrit.simulator.scene.objects import ObjectBatch, Placements
from lidargrit.simulator.scene.shapes import ShapeBuilder, lathe, sweep

VARIANTS = 16
_SKIN, _LEGS, _TOP, _SHOES, _TYRES, _FRAME = range(6)
_MATERIALS = (materials.SKIN, materials.CLOTH, materials.CLOTH, materials.CLOTH, materials.RUBBER, materials.PAINT)
_TALL_M = 1.74  # of the shapes
_TUBES = np.array(  # of a bicycle: start, end, radius in metres
    [
        (-0.52, 0, 0.34, -0.05, 0, 0.30, 0.016),
        (-0.05, 0, 0.30, 0.38, 0, 0.72, 0.024),
        (-0.15, 0, 0.75, 0.36, 0, 0.80, 0.020),
        (-0.05, 0, 0.30, -0.18, 0, 0.92, 0.018),
        (-0.52, 0, 0.34, -0.15, 0, 0.75, 0.014),
        (0.52, 0, 0.34, 0.36, 0, 1.0, 0.020),
        (0.36, -0.27, 1.0, 0.36, 0.27, 1.0, 0.016),
        (-0.30, 0, 0.95, -0.06, 0, 0.93, 0.060),
        (-0.03, -0.2, 0.30, -0.03, 0.2, 0.30, 0.03),
    ]
)


def _limb(points: tuple, radii: tuple[float, ...], sides: int = 9) -> np.ndarray:
    """Return a round limb through joints (x ahead, y left, z up), with a ring between each two."""
    joints = np.array(points, float)
    at = np.linspace(0, len(joints) - 1, 2 * len(joints) - 1)
    path = np.stack([np.interp(at, np.arange(len(joints)), joints[:, axis]) for axis in range(3)], axis=1)
    return sweep(path, np.interp(at, np.linspace(0, len(joints) - 1, len(radii)), radii), sides)


def _trunk_and_head(builder: ShapeBuilder, hip: np.ndarray, lean: float, wide: float) -> np.ndarray:
    """Add trunk and head above the hip; return the middle of the shoulders."""
    up = np.array([np.sin(lean), 0, np.cos(lean)])
    share = np.linspace(-0.06, 0.58, 8)
    trunk = sweep(hip + share[:, None] * up, wide * np.array([0.10, 0.165, 0.16, 0.15, 0.175, 0.19, 0.15, 0.06]), 12)
    middle = hip[0] + np.clip((trunk[..., 2] - hip[2]) / np.cos(lean), 0, 0.6) * np.sin(lean)
    trunk[..., 0] = middle + (trunk[..., 0] - middle) * 0.66  # flatter than it is wide
    builder.add(_TOP, trunk)
    neck = hip + 0.56 * up
    skull = np.array([0.01, 0, 1.0])
    builder.add(_SKIN, sweep(neck + np.linspace(0, 0.26, 8)[:, None] * skull,
                             np.array([0.055, 0.06, 0.075, 0.1, 0.105, 0.1, 0.07, 0.01]), 10))  # fmt: skip
    return hip + 0.50 * up


@cache
def walker_shape(variant: int) -> Shape:
    """Return one grown-up in the middle of a step, or standing; made once, from a seed of its own."""
    rng, builder = np.random.default_rng((72, variant)), ShapeBuilder(*_MATERIALS)
    stride = 0.0 if variant % 4 == 0 else rng.uniform(0.25, 0.5)
    wide = rng.uniform(0.92, 1.2)
    hip = np.array([0.0, 0.0, 0.92 - 0.06 * stride])
    skirt = variant % 5 == 0
    for side, swing in ((1, stride), (-1, -stride)):
        y = side * 0.095
        knee = hip + np.array([0.43 * np.sin(swing * 0.8), y, -0.43 * np.cos(swing * 0.8)])
        back = swing - 0.35 * (swing < 0)
        foot = knee + np.array([0.43 * np.sin(back * 0.7), 0, -0.43 * np.cos(back * 0.7)])
        foot[2] = max(foot[2], 0.07)
        builder.add(_LEGS, _limb((hip + np.array([0, y, 0]), knee, foot), (0.095, 0.085, 0.062, 0.058, 0.045)))
        builder.add(_SHOES, _limb((foot + np.array([-0.07, 0, -0.03]), foot + np.array([0.06, 0, -0.03]),
                                   foot + np.array([0.19, 0, -0.045])), (0.05, 0.055, 0.03)))  # fmt: skip
    if skirt:  # or a coat
        builder.add(_LEGS, sweep(hip + np.linspace(0.05, -0.45, 4)[:, None] * [[0, 0, 1]],
                                 np.array([0.16, 0.19, 0.21, 0.23]), 12))  # fmt: skip
    shoulders = _trunk_and_head(builder, hip, rng.uniform(0, 0.08), wide)
    for side, swing in ((1, -stride), (-1, stride)):
        y = side * 0.2 * wide
        start = shoulders + np.array([0, y, 0])
        elbow = start + np.array([0.29 * np.sin(swing), side * 0.04, -0.29 * np.cos(swing)])
        hand = elbow + np.array([0.27 * np.sin(swing + 0.3), 0, -0.27 * np.cos(swing + 0.3)])
        builder.add(_TOP, _limb((start, elbow, hand), (0.06, 0.05, 0.045, 0.04, 0.03)))
        builder.add(_SKIN, _limb((hand, hand + np.array([0.02, 0, -0.08]), hand + np.array([0.04, 0, -0.15])),
                                 (0.03, 0.045, 0.02), 6))  # fmt: skip
    if rng.random() < 0.35:  # a bag or a rucksack
        at = hip + np.array([-0.17, 0.0, 0.32])
        builder.add(_SHOES, sweep(at + np.linspace(-0.2, 0.2, 5)[:, None] * [[0, 0, 1]],
                                  np.array([0.06, 0.14, 0.15, 0.14, 0.06])))  # fmt: skip
    return builder.build()


@cache
def bicycle_shape(variant: int, ridden: bool) -> Shape:
    """Return a bicycle with somebody on it, or without; made once, from a seed of its own."""
    rng, builder = np.random.default_rng((73, variant)), ShapeBuilder(*_MATERIALS)
    turn = np.linspace(0, 2 * np.pi, 7)
    tyre = lathe(0.325 + 0.02 * np.cos(turn), 0.02 * np.sin(turn), sides=26)
    for x in (-0.52, 0.52):
        builder.add(_TYRES, tyre[..., [0, 2, 1]] + np.array([x, 0, 0.345]))
    for tube in _TUBES:
        builder.add(_FRAME, sweep(tube.reshape(-1)[:6].reshape(2, 3), np.full(2, tube[6]), 6))
    if rng.random() < 0.5:
        builder.add(_FRAME, sweep(np.array([[-0.75, 0, 0.74], [-0.3, 0, 0.74]]), np.full(2, 0.07), 6))
    if ridden:
        hip = np.array([-0.18, 0.0, 0.98])
        lean = rng.uniform(0.3, 0.65)
        for side, pedal in ((1, 0.13), (-1, -0.13)):
            y = side * 0.1
            foot = np.array([-0.03 + 0.1 * side, y, 0.32 - pedal])
            knee = (hip + foot) / 2 + np.array([0.2 + 0.08 * side, y / 2, 0.1])
            builder.add(_LEGS, _limb((hip + np.array([0, y, 0]), knee, foot), (0.095, 0.085, 0.062, 0.055, 0.045)))
            sole = tuple(foot + np.array([x, 0, -0.03]) for x in (-0.08, 0.05, 0.17))
            builder.add(_SHOES, _limb(sole, (0.045, 0.05, 0.03)))
        shoulders = _trunk_and_head(builder, hip, lean, 1.0)
        for side in (1, -1):
            start, hand = shoulders + np.array([0, side * 0.19, 0]), np.array([0.34, side * 0.25, 1.03])
            elbow = (start + hand) / 2 + np.array([-0.04, side * 0.06, -0.06])
            builder.add(_TOP, _limb((start, elbow, hand), (0.06, 0.05, 0.045, 0.04, 0.035)))
    return builder.build()


def make_walkers(rng: np.random.Generator, placements: Placements, first_instance: int) -> ObjectBatch:
    """Sample people on foot, 1 to 1.95 m tall, most of them grown up."""
    count = len(placements)
    tall = np.where(rng.random(count) < 0.12, rng.uniform(1.0, 1.5, count), rng.normal(1.72, 0.08, count))
    variant = rng.integers(0, VARIANTS, count)
    variant = np.where(placements.speed_m_s == 0, variant // 4 * 4, variant)  # they stand with their feet together
    shapes = [walker_shape(int(v)) for v in variant]
    label = np.where(placements.speed_m_s != 0, classes.MOVING_PERSON, classes.PERSON)
    return _batch(rng, shapes, tall.clip(1.0, 1.95) / _TALL_M, label, placements, first_instance)


def make_cyclists(
    rng: np.random.Generator, placements: Placements, first_instance: int, ridden: bool = True
) -> ObjectBatch:
    """Sample bicycles with somebody on them, or without."""
    count = len(placements)
    shapes = [bicycle_shape(int(v), ridden) for v in rng.integers(0, VARIANTS, count)]
    rider = np.where(placements.speed_m_s != 0, classes.MOVING_BICYCLIST, classes.BICYCLIST)
    label = rider if ridden else np.full(count, classes.BICYCLE)
    return _batch(rng, shapes, rng.uniform(0.96, 1.05, count), label, placements, first_instance)


def _batch(
    rng: np.random.Generator,
    shapes: list[Shape],
    size: np.ndarray,
    label: np.ndarray,
    placements: Placements,
    first_instance: int,
) -> ObjectBatch:
    count = len(shapes)
    albedo = np.column_stack(
        (np.full(count, 0.45), rng.uniform(0.05, 0.4, count), rng.uniform(0.05, 0.6, count), np.full(count, 0.06),
         np.full(count, 0.05), rng.uniform(0.03, 0.4, count))
    ).astype(np.float32)  # fmt: skip
    labels = tuple(np.full(len(_MATERIALS), one, np.uint16) for one in label)
    instance = np.arange(first_instance, first_instance + count, dtype=np.int32)
    return ObjectBatch(tuple(shapes), np.repeat(size[:, None], 3, axis=1), tuple(albedo), labels, instance, placements)
