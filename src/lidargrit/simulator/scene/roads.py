"""The ground: a plan → roads, kerbs, pavements, gardens, fields, lane markings, and a bridge across."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from lidargrit.scans import classes
from lidargrit.simulator import materials
from lidargrit.simulator.scene.shapes import MeshBuilder, quads
from lidargrit.simulator.scene.street_plan import StreetPlan
from lidargrit.simulator.scene.stretches import EXTENT_M, LENGTH_M, Stretch

_ROAD, _PAVEMENT, _PARKING, _YARD, _GREEN = range(5)
_LABEL = np.array([classes.ROAD, classes.SIDEWALK, classes.PARKING, classes.OTHER_GROUND, classes.TERRAIN])
_MATERIAL = np.array(
    [materials.ASPHALT, materials.CONCRETE, materials.ASPHALT, materials.CONCRETE, materials.GRASS], np.uint8
)
_MARKED_M = 48.0  # markings farther away are seen by hardly a beam
_PAINT_ALBEDO = 0.26  # where a first stretch has none to go on from
_PAINT_M = 0.012  # over the road: clear of the corners that the ground's own triangles cut


@dataclass(frozen=True, eq=False)
class GroundLook:
    """What stays the same along a road.

    Args:
        bays: whether parked rows stand on a strip of their own, right and left.
        bright: albedo of road, pavement, parking, yards and grass.
        kerb: albedo of kerbs.
    """

    bays: Bool[np.ndarray, "2"]
    bright: Float[np.ndarray, "5"]
    kerb: float


@dataclass(frozen=True)
class PaintLook:
    """What stays the same of markings along a road.

    Args:
        every: 1 if all dashes are painted, 2 for every second one; 0 for none.
        bright: albedo of all markings.
    """

    every: int
    bright: float


def add_ground(
    builder: MeshBuilder, rng: np.random.Generator, plan: StreetPlan, like: GroundLook | None = None
) -> GroundLook:
    """Add a grid of ground whose lines run along kerbs, so that kerbs are true steps.

    Args:
        like: look of the stretch before; sampled if not given.

    Returns:
        the look of this stretch.
    """
    further = plan.stretch is Stretch.FURTHER
    u = _even_lines(_u_edges(plan)) if further else _lines(_u_edges(plan), 8.0)
    v = _lines(_v_edges(plan), 14.0)
    bays = like.bays if like else rng.random(2) < 0.35
    kind = _kinds(plan, rng, bays, *np.meshgrid((u[1:] + u[:-1]) / 2, (v[1:] + v[:-1]) / 2, indexing="ij"))
    level = np.array([0.0, plan.level_m[0], 0.0, plan.level_m[1], plan.level_m[1]])[kind]
    base = plan.ground_points(*np.meshgrid(u, v, indexing="ij"))
    rough = _rough(rng, kind)
    if further:
        rough[[0, -1]] = 0  # where it meets other stretches
    base[..., 2] += rough
    corners = np.stack((base[:-1, :-1], base[1:, :-1], base[1:, 1:], base[:-1, 1:]), axis=2)
    corners[..., 2] += level[..., None]
    # Ground reads .22 to .31 in nearly all scans of KITTI, whatever the street.
    spans = (0.14, 0.22), (0.26, 0.37), (0.14, 0.22), (0.22, 0.34), (0.34, 0.44)
    bright = like.bright if like else np.array([rng.uniform(*span) for span in spans])
    albedo = bright[kind] * rng.uniform(0.97, 1.03, kind.shape)
    builder.add(quads(corners), _MATERIAL[kind][..., None], albedo[..., None], _LABEL[kind][..., None])
    kerb = like.kerb if like else rng.uniform(0.29, 0.37)
    for axis in (0, 1):
        _add_kerbs(builder, base, level, axis, kerb)
    return GroundLook(bays, bright, kerb)


def _even_lines(edges: np.ndarray) -> np.ndarray:
    """Fill the length of a further stretch with lines that are dense all along."""
    stops = np.unique(np.concatenate((edges, [-LENGTH_M / 2, LENGTH_M / 2])))
    stops = stops[np.concatenate(([True], np.diff(stops) > 0.02))]
    pieces = [np.linspace(low, high, max(int(np.ceil((high - low) / 4.0)), 1), endpoint=False)
              for low, high in pairwise(stops)]  # fmt: skip
    return np.concatenate((*pieces, [LENGTH_M / 2]))


def _lines(edges: np.ndarray, far_m: float) -> np.ndarray:
    """Fill the space between edges with lines: dense near the sensor, ``far_m`` apart far away."""
    edges = np.unique(np.clip(np.concatenate((edges, [-EXTENT_M, EXTENT_M])), -EXTENT_M, EXTENT_M))
    edges = edges[np.concatenate(([True], np.diff(edges) > 0.02))]
    pieces = []
    for low, high in pairwise(edges):
        nearest = 0.0 if low < 0 < high else min(abs(low), abs(high))
        if high - low > 40 and nearest < 40:  # long and close: denser where it is close
            inner = np.clip(np.array([-60.0, -30.0, 30.0, 60.0]), low, high)
            stops = np.unique(np.concatenate(([low], inner, [high])))
        else:
            stops = np.array([low, high])
        for start, stop in pairwise(stops):
            near = 0.0 if start < 0 < stop else min(abs(start), abs(stop))
            step = 2.5 if near < 20 else 4.0 if near < 45 else far_m
            pieces.append(np.linspace(start, stop, max(int(np.ceil((stop - start) / step)), 1), endpoint=False))
    return np.concatenate((*pieces, [EXTENT_M]))


def _u_edges(plan: StreetPlan) -> np.ndarray:
    edges = [
        street.u_m + way * (street.half_m + wide)
        for street in plan.side_streets
        for way in (-1, 1)
        for wide in (0.0, street.pavement_m)
    ]
    return np.array(edges)


def _v_edges(plan: StreetPlan) -> np.ndarray:
    edges = []
    for which, side in enumerate((-1, 1)):
        kerb = plan.edge_m[which]
        if plan.parked[which]:
            edges.append(side * (kerb - 2.1))
        edges += [side * kerb, side * (kerb + plan.pavement_m[which]), plan.front(side)]
    return np.array(edges)


def _kinds(plan: StreetPlan, rng: np.random.Generator, bays: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    green = {"city": 0.25, "suburb": 0.6, "country": 1.0}[plan.theme]
    block = (np.floor(u / 17.0) * 7 + np.floor(v / 23.0)).astype(int) % 64
    kind = np.where((rng.random(64) < green)[block], _GREEN, _YARD)
    for street in plan.side_streets:
        for side in street.sides:
            beside = np.abs(u - street.u_m) < street.half_m + street.pavement_m
            kind = np.where(beside & (v * side > 0) & (v * side < street.end_m), _PAVEMENT, kind)
    goes_on = plan.goes_on(u)
    for which, side in enumerate((-1, 1)):
        across = v * side
        kerb = plan.edge_m[which]
        kind = np.where((across > kerb) & (across < kerb + plan.pavement_m[which]) & goes_on, _PAVEMENT, kind)
        parking = plan.parked[which] and bays[which]
        kind = np.where((across >= 0) & (across < kerb) & goes_on, _ROAD, kind)
        if parking:
            clear = (plan.in_side_street(u, v, 3.0) < 0) & goes_on
            kind = np.where((across > kerb - 2.1) & (across < kerb) & clear, _PARKING, kind)
    return np.where(plan.in_side_street(u, v) > 0, _ROAD, kind)


def _rough(rng: np.random.Generator, kind: np.ndarray) -> np.ndarray:
    """Return bumps for the corners that touch nothing but grass."""
    wide = np.pad(kind, 1, mode="edge")
    grass = (wide[:-1, :-1] >= _YARD) & (wide[1:, :-1] >= _YARD) & (wide[:-1, 1:] >= _YARD) & (wide[1:, 1:] >= _YARD)
    return np.where(grass, rng.normal(0, 0.04, grass.shape), 0.0)


def _add_kerbs(builder: MeshBuilder, base: np.ndarray, level: np.ndarray, axis: int, albedo: float) -> None:
    """Stand an upright strip wherever the levels of neighbouring cells differ."""
    if axis == 1:
        base, level = base.swapaxes(0, 1), level.swapaxes(0, 1)
    low, high = np.minimum(level[:-1], level[1:]), np.maximum(level[:-1], level[1:])
    i, j = np.nonzero(high - low > 1e-3)
    start, end = base[i + 1, j], base[i + 1, j + 1]
    rise = np.zeros((len(i), 4, 3))
    rise[:, :2, 2], rise[:, 2:, 2] = low[i, j][:, None], high[i, j][:, None]
    builder.add(quads(np.stack((start, end, end, start), axis=1) + rise), materials.CONCRETE, albedo, classes.SIDEWALK)


def add_markings(
    builder: MeshBuilder, rng: np.random.Generator, plan: StreetPlan, like: PaintLook | None = None
) -> PaintLook:
    """Paint the middle of the road, its edges out of town, and stop lines and zebra crossings at junctions.

    Args:
        like: look of the stretch before; sampled if not given.

    Returns:
        the look of this stretch.
    """
    bars: list[np.ndarray] = []  # columns: u from, u to, v from, v to
    along = np.arange(*plan.stretch.span(_MARKED_M), 3.0)
    every = like.every if like else 0
    if not like and plan.lanes == 2 and rng.random() < {"city": 0.8, "suburb": 0.4, "country": 0.9}[plan.theme]:
        every = int(rng.choice([1, 2, 3]))
    if every:
        dashes = along[::every]
        bars.append(np.column_stack((dashes, dashes + 3.0, dashes * 0 - 0.06, dashes * 0 + 0.06)))
    if plan.theme == "country":
        for side in (-1, 1):
            line = along * 0 + plan.edge(side) - side * 0.3
            bars.append(np.column_stack((along, along + 3.0, line - 0.06, line + 0.06)))
    for street in plan.side_streets:
        if not plan.stretch.keeps(np.array([street.u_m]), _MARKED_M)[0]:
            continue
        for side in street.sides:
            kerb = plan.edge(side)
            if rng.random() < 0.5:  # dashes along the mouth
                dash = street.u_m + np.arange(-street.half_m, street.half_m, 1.0)
                bars.append(np.column_stack((dash, dash + 0.5, dash * 0 + kerb - 0.12, dash * 0 + kerb + 0.12)))
        if plan.theme == "city" and rng.random() < 0.5:
            bars.append(_zebra(plan, street.u_m + rng.choice([-1, 1]) * (street.half_m + street.pavement_m + 2.5)))
    clear = [bar[plan.in_side_street(bar[:, 0], bar[:, 2]) < 0] for bar in bars[:1]] + bars[1:]
    if not clear:
        return like or PaintLook(every, _PAINT_ALBEDO)
    bar = np.concatenate(clear)
    bar = bar[plan.goes_on(bar[:, 0])]
    corners = plan.ground_points(bar[:, [0, 1, 1, 0]], bar[:, [2, 2, 3, 3]])
    corners[..., 2] += _PAINT_M
    bright = like.bright if like else rng.uniform(0.2, 0.32)  # KITTI's read .37, half as much as road again
    albedo = bright * rng.uniform(0.85, 1.0, (len(bar), 1))
    builder.add(quads(corners), materials.ASPHALT, albedo, classes.LANE_MARKING)
    return PaintLook(every, bright)


def _zebra(plan: StreetPlan, u_m: float) -> np.ndarray:
    stripe = np.arange(-plan.edge_m[0] + 0.5, plan.edge_m[1] - 0.5, 1.0)
    return np.column_stack((stripe * 0 + u_m - 1.5, stripe * 0 + u_m + 1.5, stripe, stripe + 0.5))


def add_bridge(builder: MeshBuilder, rng: np.random.Generator, plan: StreetPlan) -> None:
    """Let another road cross above ours: a deck with parapets between two banks that end in walls."""
    if not np.isfinite(plan.bridge_u_m):
        return
    half, low, thick = rng.uniform(3, 8), rng.uniform(4.3, 5.2), rng.uniform(0.6, 1.2)
    walls = [plan.edge(side) + side * (plan.pavement_m[(side + 1) // 2] + 0.6) for side in (-1, 1)]
    u, top, concrete = plan.bridge_u_m, low + thick, rng.uniform(0.2, 0.4)
    for side, wall in zip((-1, 1), walls, strict=True):
        v = side * np.linspace(abs(wall), 75.0, 8)
        bank = plan.blocks(u - half, u + half, v[:-1], v[1:], -0.5, top, flare_m=5.0)
        builder.add(bank, materials.GRASS, rng.uniform(0.3, 0.5), classes.TERRAIN)
        ends = plan.blocks(u - half - 0.2, u + half + 0.2, wall, wall + side * 0.8, -0.5, top)
        builder.add(ends, materials.CONCRETE, concrete, classes.OTHER_STRUCTURE)
    v = np.concatenate((np.linspace(-75, walls[0], 6), np.linspace(walls[1], 75, 6)))
    deck = plan.blocks(u - half, u + half, walls[0], walls[1], low, top)
    rails = [plan.blocks(u + way * half - 0.1, u + way * half + 0.1, v[:-1], v[1:], top, top + 0.9) for way in (-1, 1)]
    builder.add(np.concatenate((deck, *rails)), materials.CONCRETE, concrete, classes.OTHER_STRUCTURE)
