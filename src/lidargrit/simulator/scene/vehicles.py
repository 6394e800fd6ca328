"""Vehicles: body types → kept shapes lofted over cubic profiles; kinds and places → objects of these shapes."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Int
from scipy.interpolate import PchipInterpolator

from lidargrit.simulator import materials
from lidargrit.simulator.mesh import Shape
from lidargrit.simulator.scene.body_types import BODY_TYPES, BUS, LORRY, PANEL_VAN, SHARES, BodyType
from lidargrit.simulator.scene.objects import ObjectBatch, Placements
from lidargrit.simulator.scene.shapes import ShapeBuilder, fans, lathe, loft, quads

VARIANTS = 10  # of each body type
_PAINT, _GLASS, _RUBBER, _METAL, _DARK, _PLATE, _CARGO = range(7)
_MATERIALS = (materials.PAINT, materials.GLASS, materials.RUBBER, materials.METAL, materials.CLOTH, materials.FOIL,
              materials.PAINT)  # fmt: skip
# Half a cross-section from the sill up: share of the half width, and of the height from the sill to the belt.
_FLANK_WIDTH = np.array([0.90, 0.965, 0.995, 1.0, 0.985, 0.965])
_FLANK_HEIGHT = np.array([0.0, 0.10, 0.35, 0.6, 0.85, 1.0])
_PANE = np.array([0.06, 0.5, 0.9, 1.0])  # share of the way from the belt to the edge of the roof
_ROOF_WIDTH, _ROOF_HEIGHT = np.array([0.72, 0.36, 0.0]), np.array([0.6, 0.93, 1.0])
_PANE_BANDS, _SCREEN_BANDS = (6, 7), (9, 10, 11)
_CROWN_M = 0.06  # from the edge of the roof to its middle


@dataclass(frozen=True, eq=False)
class _Body:
    """One vehicle's own measures: a body type with the chances of a variant."""

    kind: BodyType
    length_m: float
    width_m: float
    height_m: float

    def x_m(self, behind_nose: np.ndarray | float) -> np.ndarray:
        return self.length_m * (0.5 - np.asarray(behind_nose, np.float64))

    @property
    def arch_m(self) -> float:
        return self.kind.wheel_m + 0.06

    def outline(self, behind: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the heights of sill, belt and roof and half the width at stations; arches cut into the sill."""
        kind = self.kind
        top = self.height_m * PchipInterpolator(*np.array(kind.top).T)(behind)
        half = self.width_m / 2 * PchipInterpolator(*np.array(kind.plan).T)(behind)
        belt = self.height_m * np.interp(behind, (0.0, 1.0), kind.belt)
        low = kind.clearance_m + 0.10 * np.clip(1 - behind / 0.06, 0, 1) + 0.14 * np.clip((behind - 0.93) / 0.07, 0, 1)
        for axle in kind.axles:
            apart = self.length_m * (behind - axle)
            inside = np.abs(apart) < self.arch_m
            arch = kind.wheel_m + np.sqrt(np.maximum(self.arch_m**2 - apart**2, 0))
            low = np.where(inside, np.maximum(low, arch), low)
        belt = np.minimum(belt, top - _CROWN_M - 0.012)
        return low, np.maximum(belt, low + 0.02), top, half

    def stations(self) -> np.ndarray:
        """Return shares of the length behind the nose: an even row, the profiles' knots, and dense ones at arches."""
        reach = self.arch_m / self.length_m
        arches = [axle + reach * np.cos(np.linspace(0.0, np.pi, 11)) for axle in self.kind.axles]
        panes = [np.array(span) for span in (*self.kind.windows, self.kind.windscreen, self.kind.rear_screen)]
        every = np.unique(np.concatenate([np.linspace(0, 1, 26), *(k[0] for k in [np.array(self.kind.top).T]),
                                          *arches, *panes]))  # fmt: skip
        every = every[(every >= 0) & (every <= 1)]
        return every[np.concatenate(([True], np.diff(every) > 0.0015))]


def _skin(builder: ShapeBuilder, body: _Body) -> None:
    """Loft the body over its stations; panes lie between belt and roof, at intervals that leave the pillars."""
    behind = body.stations()
    low, belt, top, half = body.outline(behind)
    edge = top - _CROWN_M
    cabin = edge - belt
    shoulder = half * _FLANK_WIDTH[-1]
    roof = np.maximum(shoulder - body.kind.tumble * cabin - 0.02, 0.25 * shoulder)
    y = np.concatenate((half[:, None] * _FLANK_WIDTH, shoulder[:, None] + (roof - shoulder)[:, None] * _PANE,
                        roof[:, None] * _ROOF_WIDTH), axis=1)  # fmt: skip
    z = np.concatenate((low[:, None] + (belt - low)[:, None] * _FLANK_HEIGHT, belt[:, None] + cabin[:, None] * _PANE,
                        edge[:, None] + _CROWN_M * _ROOF_HEIGHT), axis=1)  # fmt: skip
    x = np.broadcast_to(body.x_m(behind)[:, None], y.shape)
    left = np.stack((x, y, z), axis=-1)
    middle = (behind[1:] + behind[:-1]) / 2
    glass = np.zeros((len(middle), left.shape[1] - 1), bool)
    high = np.minimum(cabin[1:], cabin[:-1]) > 0.1
    for start, stop in body.kind.windows:
        glass[:, _PANE_BANDS] |= ((middle > start) & (middle < stop) & high)[:, None]
    for start, stop in (body.kind.windscreen, body.kind.rear_screen):
        glass[:, _SCREEN_BANDS] |= ((middle > start) & (middle < stop))[:, None]
    for side in (1, -1):
        strip = left * np.array([1, side, 1])
        quad = np.stack((strip[:-1, :-1], strip[1:, :-1], strip[1:, 1:], strip[:-1, 1:]), axis=2)
        builder.add(_PAINT, quads(quad[~glass]))
        builder.add(_GLASS, quads(quad[glass]))
    ends = np.concatenate((left, left[:, ::-1] * np.array([1, -1, 1])), axis=1)[[0, -1]]
    builder.add(_PAINT, fans(ends))


def _running_gear(builder: ShapeBuilder, body: _Body) -> None:
    """Stand tyres with rims on the ground in wells that are closed inwards, and hang a floor between them."""
    kind, radius = body.kind, body.kind.wheel_m
    wide = 0.115 if radius < 0.42 else 0.16  # half the width of a tyre
    tyre = lathe(radius * np.array([0.62, 0.7, 0.96, 1.0, 1.0, 0.96, 0.6]),
                 wide * np.array([0.8, 1.0, 1.0, 0.7, -0.7, -1.0, -1.0]), sides=24)  # fmt: skip
    rim = lathe(radius * np.array([0.0, 0.25, 0.45, 0.63]), wide * np.array([0.75, 0.85, 0.5, 0.8]), sides=14)
    turn = np.linspace(0, np.pi, 12)
    for axle in kind.axles:
        at = np.array([body.x_m(axle), 0.0, radius])
        for side in (-1, 1):
            hub = at + np.array([0, side * (body.width_m / 2 - wide - 0.02), 0])
            for part, wheel in ((_RUBBER, tyre), (_METAL, rim)):  # the axis of the lathe becomes the axle
                builder.add(part, np.stack((wheel[..., 0], side * wheel[..., 2], wheel[..., 1]), axis=-1) + hub)
            arc = at + body.arch_m * np.stack((np.cos(turn), 0 * turn, np.sin(turn)), axis=1)
            outer, inner = (arc + np.array([0, side * (body.width_m / 2 - deep), 0]) for deep in (0.02, 0.36))
            well = np.stack((outer[:-1], outer[1:], inner[1:], inner[:-1]), axis=1)
            builder.add(_DARK, quads(well))
            foot = inner[[0, -1]] - np.array([0, 0, radius - kind.clearance_m])
            builder.add(_DARK, fans(np.concatenate((foot[:1], inner, foot[1:]))))
    ends, half = body.x_m(np.array([0.97, 0.03])), body.width_m * 0.32
    builder.add_box(_DARK, (ends[0], -half, kind.clearance_m), (ends[1], half, kind.clearance_m + 0.1))


def _cabin(builder: ShapeBuilder, body: _Body) -> None:
    """Put a dashboard, seats with heads and a floor behind the panes, mirrors outside, and plates at the ends."""
    kind = body.kind
    belt = body.height_m * kind.belt[0]
    half = body.width_m * 0.40
    for row in kind.seats:
        back = float(body.x_m(row))
        for y in (-half / 2 - 0.03, half / 2 + 0.03):
            builder.add_box(_DARK, (back - 0.12, y - 0.24, belt - 0.5), (back, y + 0.24, belt + 0.16))
            builder.add_box(_DARK, (back - 0.11, y - 0.13, belt + 0.18), (back - 0.02, y + 0.13, belt + 0.38))
    start, stop = max(kind.windows[0][0] - 0.06, 0.03), max(span[1] for span in (*kind.windows, kind.rear_screen))
    builder.add_box(_DARK, (float(body.x_m(stop)), -half, 0.42), (float(body.x_m(start)), half, belt - 0.3))
    mirror = kind.windows[0][0] + 0.02
    for side in (-1, 1):
        corner = np.array([body.x_m(mirror) - 0.07, side * (body.width_m / 2 + 0.09) - 0.09, belt + 0.0])
        builder.add_box(_PAINT, corner, corner + np.array([0.1, 0.18, 0.14 if kind.seats[0] > 0.3 else 0.3]))
    for end, low in ((1, 0.42), (-1, 0.52 if kind.wheel_m < 0.42 else 0.6)):  # 0.52 x 0.11 m as in Europe
        x = end * (body.length_m / 2 + 0.015)
        corners = [(x, y, z) for y, z in ((-0.26, low), (0.26, low), (0.26, low + 0.11), (-0.26, low + 0.11))]
        builder.add(_PLATE, quads(np.array(corners)))


def _cargo(builder: ShapeBuilder, body: _Body) -> None:
    """Put the box of a lorry on its frame."""
    half, nose, tail = body.width_m / 2, float(body.x_m(0.29)), float(body.x_m(1.0))
    corner = np.array([-0.5, -0.47, 0.47, 0.5, 0.5, 0.47, -0.47, -0.5]) * 2 * half
    edge = np.array([0.0, 0.0, 0.0, 0.05, 0.96, 1.0, 1.0, 0.96])
    ring = np.stack((0 * corner, corner, 1.05 + (body.height_m - 1.05) * edge), axis=1)
    rings = ring + np.stack((np.linspace(tail, nose, 6), np.zeros(6), np.zeros(6)), axis=1)[:, None]
    builder.add(_CARGO, loft(rings[None]))
    builder.add(_CARGO, fans(rings[[0, -1]]))
    builder.add_box(_DARK, (tail, -0.45, 0.6), (nose, 0.45, 1.05))
    for side in (-1, 1):  # the guard between the axles, and the lamps' beam behind
        y = side * (half - 0.08)
        builder.add_box(_METAL, (float(body.x_m(0.62)), y - 0.03, 0.45), (float(body.x_m(0.34)), y + 0.03, 0.85))


@cache
def vehicle_shape(kind: int, variant: int) -> Shape:
    """Return one vehicle of a body type; it is made once, from a seed of its own."""
    rng, body_type = np.random.default_rng((71, kind, variant)), BODY_TYPES[kind]
    stretch = 1 + np.array(body_type.spread) * np.clip(rng.normal(size=3), -1.6, 1.6)
    body = _Body(body_type, *(float(size) for size in np.array(body_type.size_m) * stretch))
    builder = ShapeBuilder(*_MATERIALS)
    _skin(builder, body)
    _running_gear(builder, body)
    _cabin(builder, body)
    if kind == LORRY:
        _cargo(builder, body)
    return builder.build()


def sample_vehicle_kinds(rng: np.random.Generator, count: int, large: float) -> Int[np.ndarray, " n"]:
    """Sample what kinds of vehicle stand or drive in a European street; ``large`` is the share of lorries and buses."""
    shares = np.array(SHARES) * (1 - large)
    shares[[LORRY, BUS]] = 0.6 * large, 0.4 * large
    return rng.choice(len(BODY_TYPES), count, p=shares / shares.sum())


def make_vehicles(
    rng: np.random.Generator, kinds: Int[np.ndarray, " n"], placements: Placements, first_instance: int
) -> ObjectBatch:
    """Sample vehicles of given kinds: a shape, a colour and an instance each."""
    count = len(kinds)
    shapes = tuple(vehicle_shape(int(k), int(v)) for k, v in zip(kinds, rng.integers(0, VARIANTS, count), strict=True))
    dark = rng.random(count) < 0.7
    paint = np.where(dark, np.exp(rng.uniform(np.log(0.0006), np.log(0.015), count)), rng.uniform(0.08, 0.34, count))
    paint = np.where(kinds >= PANEL_VAN, np.maximum(paint, rng.uniform(0.02, 0.4, count)), paint)
    albedo = np.empty((count, len(_MATERIALS)), np.float32)
    albedo[:, _PAINT], albedo[:, _GLASS], albedo[:, _RUBBER], albedo[:, _PLATE] = paint, 0.02, 0.03, 0.5
    albedo[:, _METAL], albedo[:, _DARK] = rng.uniform(0.1, 0.4, count), rng.uniform(0.02, 0.08, count)
    albedo[:, _CARGO] = rng.uniform(0.1, 0.5, count)
    moves = placements.speed_m_s != 0
    label = [np.full(len(_MATERIALS), BODY_TYPES[kind].moving if go else BODY_TYPES[kind].label, np.uint16)
             for kind, go in zip(kinds, moves, strict=True)]  # fmt: skip
    size = 1 + 0.012 * np.clip(rng.normal(size=(count, 3)), -1.5, 1.5)
    instance = np.arange(first_instance, first_instance + count, dtype=np.int32)
    return ObjectBatch(shapes, size, tuple(albedo), tuple(label), instance, placements, leans=True)
