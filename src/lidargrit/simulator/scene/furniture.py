"""Things on pavements: kinds → kept shapes of lamps, signs, bins, cabinets, benches, planters; places → objects."""

from collections.abc import Callable
from functools import cache

import numpy as np
from jaxtyping import Int

from lidargrit.scans import classes
from lidargrit.simulator import materials
from lidargrit.simulator.mesh import Shape
from lidargrit.simulator.scene.objects import ObjectBatch, Placements
from lidargrit.simulator.scene.shapes import ShapeBuilder, fans, lathe, leaves, loft, sweep

_POLE, _FACE, _BACK, _BODY, _STONE, _GREEN, _PANE, _BOARD, _RAIL = range(9)
_MATERIALS = (materials.METAL, materials.FOIL, materials.METAL, materials.PAINT, materials.CONCRETE, materials.LEAVES,
              materials.GLASS, materials.BARK, materials.METAL)  # fmt: skip
_LABELS = (classes.POLE, classes.TRAFFIC_SIGN, classes.TRAFFIC_SIGN, *(classes.OTHER_OBJECT,) * 2, classes.VEGETATION,
           classes.OTHER_OBJECT, *(classes.FENCE,) * 2)  # fmt: skip
VARIANTS = 8
HOARDING_M, RAILING_M, SCAFFOLD_M = 6.0, 4.0, 5.0  # lengths of pieces, along x


def _mast(builder: ShapeBuilder, tall: float, radius: float, taper: float = 0.6, y: float = 0.0) -> None:
    """Stand a pole with a thicker foot."""
    share = np.array([-0.04, 0.14, 0.15, 0.5, 1.0])
    path = np.column_stack((0 * share, 0 * share + y, share * tall))
    builder.add(_POLE, sweep(path, radius * np.array([1.35, 1.35, 1.0, (1 + taper) / 2, taper]), 10))


def _lamp(builder: ShapeBuilder, rng: np.random.Generator) -> None:
    """A street lamp whose arm reaches along x, or a lower one with a head on top."""
    if rng.random() < 0.3:
        tall = rng.uniform(3.2, 4.5)
        _mast(builder, tall, 0.05)
        head = lathe(np.array([0.05, 0.2, 0.24, 0.16, 0.0]), tall + np.array([0, 0.1, 0.25, 0.42, 0.46]), 12)
        builder.add(_POLE, head)
        return
    tall, reach = rng.uniform(6.5, 9.5), rng.uniform(0.6, 2.2)
    _mast(builder, tall, rng.uniform(0.07, 0.1))
    turn = np.linspace(0, np.pi / 2, 6)
    arm = np.column_stack((reach * np.sin(turn), 0 * turn, tall + 0.5 * (1 - np.cos(turn))))
    builder.add(_POLE, sweep(arm, np.full(6, 0.035), 6))
    tip = arm[-1]
    builder.add_box(_POLE, tip + np.array([-0.1, -0.15, -0.06]), tip + np.array([0.55, 0.15, 0.08]))


def _sign(builder: ShapeBuilder, rng: np.random.Generator) -> None:
    """A traffic sign that faces along -x: a triangle, square, octagon or disc, at times with a plate below."""
    tall = rng.uniform(2.5, 3.3)
    _mast(builder, tall, 0.032, taper=1.0)
    corners, radius = int(rng.choice([3, 4, 8, 20])), rng.uniform(0.3, 0.42)
    turn = (np.pi / 2 if corners == 3 else np.pi / corners) + 2 * np.pi / corners * np.arange(corners)
    rim = np.stack((0 * turn, radius * np.cos(turn), radius * np.sin(turn) + tall - radius), axis=1)
    plates = [rim]
    if rng.random() < 0.4:
        low = tall - 2 * radius - 0.35
        plates.append(np.array([(0, -0.3, low), (0, 0.3, low), (0, 0.3, low + 0.25), (0, -0.3, low + 0.25)]))
    for plate in plates:
        for x, part in ((-0.05, _FACE), (-0.038, _BACK)):
            builder.add(part, fans(plate + np.array([x, 0, 0])))


def _guide(builder: ShapeBuilder, rng: np.random.Generator) -> None:
    """A board with directions on two posts."""
    half, low = rng.uniform(0.5, 1.1), rng.uniform(0.9, 1.9)
    high = low + rng.uniform(0.6, 1.2)
    for y in (-half * 0.8, half * 0.8):
        _mast(builder, high, 0.035, 1.0, y)
    board = np.array([(0.0, -half, low), (0.0, half, low), (0.0, half, high), (0.0, -half, high)])
    for x, part in ((-0.05, _FACE), (-0.038, _BACK)):
        builder.add(part, fans(board + np.array([x, 0, 0])))


def _signal(builder: ShapeBuilder, rng: np.random.Generator) -> None:
    tall = rng.uniform(3.0, 3.6)
    _mast(builder, tall, 0.06, 1.0)
    builder.add_box(_BODY, (-0.28, -0.15, tall - 1.0), (-0.06, 0.15, tall - 0.05))
    builder.add_box(_BODY, (-0.2, -0.12, 2.0), (-0.05, 0.12, 2.0 + 0.3))


def _bin(builder: ShapeBuilder, rng: np.random.Generator) -> None:
    """Wheeled bins in a row, with lids that overhang."""
    for at in range(int(rng.integers(1, 4))):
        y, wide, tall = 0.68 * at, rng.uniform(0.24, 0.3), rng.uniform(0.95, 1.1)
        corner = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
        outline = ((0.75, 0.08), (1.0, tall - 0.12), (1.1, tall - 0.1), (1.1, tall - 0.04), (0.8, tall))
        rings = np.array(
            [[(2 * wide * grow * a, 2 * wide * grow * b + y, z) for a, b in corner] for grow, z in outline]
        )
        builder.add(_BODY, loft(rings[None]))
        builder.add(_BODY, fans(rings[-1]))


def _cabinet(builder: ShapeBuilder, rng: np.random.Generator) -> None:
    """A cabinet of a power or telephone company, with a roof that overhangs."""
    half, tall = np.array([rng.uniform(0.15, 0.22), rng.uniform(0.3, 0.8)]), rng.uniform(0.9, 1.5)
    builder.add_box(_BODY, (*-half, -0.2), (*half, tall))
    builder.add_box(_BODY, (*-(half + 0.03), tall), (*(half + 0.03), tall + 0.05))


def _bench(builder: ShapeBuilder, rng: np.random.Generator) -> None:
    """A bench that faces along -x."""
    half = rng.uniform(0.7, 1.0)
    for z, x in ((0.44, -0.1), (0.44, 0.06), (0.44, 0.22), (0.62, 0.32), (0.8, 0.37)):
        builder.add_box(_BODY, (x - 0.06, -half, z - 0.02), (x + 0.06, half, z + 0.02))
    for y in (-half + 0.1, half - 0.1):
        builder.add_box(_POLE, (-0.15, y - 0.03, -0.1), (0.3, y + 0.03, 0.43))


def _planter(builder: ShapeBuilder, rng: np.random.Generator) -> None:
    """A tub with a shrub."""
    wide, tall = rng.uniform(0.35, 0.6), rng.uniform(0.45, 0.7)
    builder.add(_STONE, lathe(wide * np.array([0.75, 0.95, 1.0, 0.9]), np.array([-0.1, tall - 0.1, tall, tall]), 14))
    number = 420
    way = rng.normal(size=(number, 3))
    way *= rng.random((number, 1)) ** 0.4 / np.linalg.norm(way, axis=1, keepdims=True)
    centre = way * np.array([wide, wide, 0.4]) + np.array([0, 0, tall + 0.3])
    builder.add(_GREEN, leaves(centre, rng.uniform(0.04, 0.08, number)))


def _column(builder: ShapeBuilder, rng: np.random.Generator) -> None:
    """An advertising column with its cap."""
    wide, tall = rng.uniform(0.5, 0.7), rng.uniform(2.4, 3.2)
    outline = wide * np.array([1.08, 1.08, 1.0, 1.0, 1.12, 1.12, 0.6, 0.0])
    builder.add(_STONE, lathe(outline, np.array([-0.2, 0.3, 0.3, tall, tall, tall + 0.1, tall + 0.4, tall + 0.5]), 20))


def _shelter(builder: ShapeBuilder, rng: np.random.Generator) -> None:
    """A bus shelter with glass at its back and one end, open along -x."""
    half = rng.uniform(1.4, 2.2)
    builder.add_box(_BODY, (-0.8, -half - 0.1, 2.3), (0.8, half + 0.1, 2.42))
    for x, y in ((0.65, -half), (0.65, 0.0), (0.65, half), (-0.6, -half), (-0.6, half)):
        builder.add(_POLE, sweep(np.array([(x, y, -0.1), (x, y, 2.3)]), np.full(2, 0.045), 6))
    panes = [[(0.65, -half, 0.2), (0.65, half, 0.2), (0.65, half, 2.2), (0.65, -half, 2.2)],
             [(-0.6, half, 0.2), (0.65, half, 0.2), (0.65, half, 2.2), (-0.6, half, 2.2)]]  # fmt: skip
    builder.add(_PANE, fans(np.array(panes)))
    builder.add_box(_BODY, (0.25, -half + 0.3, 0.42), (0.55, half - 0.3, 0.48))


def _bollard(builder: ShapeBuilder, rng: np.random.Generator) -> None:
    tall, wide = rng.uniform(0.8, 1.1), rng.uniform(0.05, 0.09)
    builder.add(_POLE, lathe(wide * np.array([1.3, 1.3, 1.0, 1.0, 0.7, 0.0]),
                             tall * np.array([-0.2, 0.12, 0.14, 0.9, 0.98, 1.0]), 12))  # fmt: skip


def _meter(builder: ShapeBuilder, rng: np.random.Generator) -> None:
    """A parking meter or letter box on a post."""
    _mast(builder, 1.1, 0.045, 1.0)
    high = rng.uniform(0.4, 0.65)
    builder.add_box(_BODY, (-0.16, -0.2, 1.0), (0.12, 0.2, 1.0 + high))


def _hoarding(builder: ShapeBuilder, rng: np.random.Generator) -> None:
    """A piece of the boards around a building site, or of a fence of bars on feet of concrete."""
    half, tall = HOARDING_M / 2, rng.uniform(1.8, 2.3)
    if rng.random() < 0.6:
        for x in np.arange(-half, half, HOARDING_M / 4):  # boards stand a little before and behind one another
            deep = rng.uniform(0.0, 0.04)
            builder.add_box(_BOARD, (x, deep - 0.03, 0.05), (x + HOARDING_M / 4, deep + 0.03, tall))
        return
    for x in np.linspace(-half, half, 40):
        builder.add_box(_RAIL, (x - 0.012, -0.012, 0.15), (x + 0.012, 0.012, tall))
    for x in (-half, 0.0, half):
        builder.add_box(_STONE, (x - 0.12, -0.35, -0.05), (x + 0.12, 0.35, 0.14))
    for z in (0.15, tall - 0.05):
        builder.add_box(_RAIL, (-half, -0.02, z), (half, 0.02, z + 0.04))


def _railing(builder: ShapeBuilder, rng: np.random.Generator) -> None:
    """A piece of the railing between pavement and road."""
    half, tall = RAILING_M / 2, rng.uniform(0.95, 1.1)
    for x in np.linspace(-half, half, int(rng.choice([3, 17]))):
        wide = 0.03 if abs(abs(x) - half) < 0.01 or not x else 0.012
        builder.add_box(_RAIL, (x - wide, -wide, -0.1), (x + wide, wide, tall))
    for z in (0.12, tall / 2, tall):
        builder.add_box(_RAIL, (-half, -0.025, z - 0.03), (half, 0.025, z + 0.03))


def _scaffold(builder: ShapeBuilder, rng: np.random.Generator) -> None:
    """A piece of a scaffold before a front: tubes, planks, at times a net."""
    half, storeys = SCAFFOLD_M / 2, int(rng.integers(2, 6))
    tall = 2.0 * storeys + 1.0
    for x in (-half, 0.0, half):
        for y in (-0.4, 0.4):
            builder.add_box(_POLE, (x - 0.03, y - 0.03, -0.2), (x + 0.03, y + 0.03, tall))
    for z in 2.0 * np.arange(1, storeys + 1) + 0.2:
        builder.add_box(_BODY, (-half, -0.4, z), (half, 0.4, z + 0.05))
        for rail in (0.5, 1.0):
            for y in (-0.4, 0.4):
                builder.add_box(_POLE, (-half, y - 0.025, z + rail), (half, y + 0.025, z + rail + 0.05))


def _stall(builder: ShapeBuilder, rng: np.random.Generator) -> None:
    """A stall or kiosk that is open along -y: a counter, a back and a roof that overhangs."""
    half, deep, tall = rng.uniform(1.0, 1.8), rng.uniform(0.6, 1.0), rng.uniform(2.3, 2.7)
    builder.add_box(_BODY, (-half, -deep, 0.0), (half, -deep + 0.5, 0.95))
    builder.add_box(_BODY, (-half, deep - 0.06, 0.0), (half, deep, tall))
    builder.add_box(_BODY, (-half - 0.2, -deep - 0.5, tall), (half + 0.2, deep + 0.1, tall + 0.1))
    for x in (-half, half):
        builder.add_box(_POLE, (x - 0.04, -deep, 0.0), (x + 0.04, -deep + 0.08, tall))


def _box(builder: ShapeBuilder, rng: np.random.Generator) -> None:
    """A skip, a container for glass, a toilet hut or a pile of crates: a body that widens upwards, with a rim."""
    sizes = [(1.8, 0.9, 1.3), (0.75, 0.75, 1.7), (0.55, 0.55, 2.2), (0.6, 0.4, 1.2)]
    length, wide, tall = rng.choice(sizes) * rng.uniform(0.9, 1.1, 3)
    corner = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    slope = rng.uniform(0.8, 1.0)
    outline = ((slope, 0.0), (1.0, tall - 0.12), (1.05, tall - 0.12), (1.05, tall))
    rings = np.array([[(length * grow * a, wide * grow * b, z) for a, b in corner] for grow, z in outline])
    builder.add(_BODY, loft(rings[None]))
    builder.add(_BODY, fans(rings[-1]))


def _bed(builder: ShapeBuilder, rng: np.random.Generator) -> None:
    """A low wall, or a raised bed with shrubs."""
    half, wide, tall = rng.uniform(1.2, 3.5), rng.uniform(0.15, 0.6), rng.uniform(0.4, 0.9)
    builder.add_box(_STONE, (-half, -wide, -0.2), (half, wide, tall))
    if wide > 0.3:
        number = int(160 * half)
        way = rng.uniform(-1, 1, (number, 3)) * np.array([half, wide, 0.3]) + np.array([0, 0, tall + 0.3])
        builder.add(_GREEN, leaves(way, rng.uniform(0.04, 0.09, number)))


def _rack(builder: ShapeBuilder, rng: np.random.Generator) -> None:
    """Stands to which bicycles are locked, in a row along y."""
    for y in np.arange(int(rng.integers(3, 8))) * 0.9:
        for low, high in ((-0.38, -0.33), (0.33, 0.38)):
            builder.add_box(_POLE, (low, y - 0.025, -0.1), (high, y + 0.025, 0.8))
        builder.add_box(_POLE, (-0.38, y - 0.025, 0.8), (0.38, y + 0.025, 0.85))


(LAMP, SIGN, GUIDE, SIGNAL, BIN, CABINET, BENCH, PLANTER, COLUMN, SHELTER, BOLLARD, METER, HOARDING, RAILING, SCAFFOLD,
 STALL, BOX, BED, RACK) = range(19)  # fmt: skip
_MAKERS: tuple[Callable[[ShapeBuilder, np.random.Generator], None], ...] = (
    _lamp, _sign, _guide, _signal, _bin, _cabinet, _bench, _planter, _column, _shelter, _bollard, _meter, _hoarding,
    _railing, _scaffold, _stall, _box, _bed, _rack,
)  # fmt: skip


@cache
def furniture_shape(kind: int, variant: int) -> Shape:
    """Return one thing; it is made once, from a seed of its own."""
    builder = ShapeBuilder(*_MATERIALS)
    _MAKERS[kind](builder, np.random.default_rng((77, kind, variant)))
    return builder.build()


def make_furniture(
    rng: np.random.Generator, kinds: Int[np.ndarray, " n"], variants: Int[np.ndarray, " n"], placements: Placements
) -> ObjectBatch:
    """Make things of given kinds and variants at places, each of a colour of its own."""
    count = len(kinds)
    shapes = [furniture_shape(int(kind), int(variant)) for kind, variant in zip(kinds, variants, strict=True)]
    albedo = np.column_stack((rng.uniform(0.08, 0.3, count), np.full(count, 0.5), np.full(count, 0.3),
                              rng.uniform(0.04, 0.5, count), rng.uniform(0.2, 0.4, count),
                              rng.uniform(0.3, 0.6, count), np.full(count, 0.02), rng.uniform(0.2, 0.6, count),
                              rng.uniform(0.08, 0.4, count)))  # fmt: skip
    return ObjectBatch.standing(shapes, np.ones((count, 3)), albedo, _LABELS, placements)
