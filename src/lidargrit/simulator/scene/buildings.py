"""Houses: positions and sizes → walls with windows, doors, balconies, roofs."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Num

from lidargrit.scans import classes
from lidargrit.simulator import materials
from lidargrit.simulator.scene.shapes import MeshBuilder, blocks, boxes, owners, quads, rows_of
from lidargrit.simulator.scene.street_plan import Poses, StreetPlan

_SINK_M = 1.5  # walls go on below the ground, which may fall away
_RELIEF_TO_M = 40.0  # how deep windows lie farther away is less than a beam is wide
_BALCONIES_TO_M = 60.0  # they are a metre or two wide
_WINDOWS_TO_M = 85.0  # a window farther away is hit by a beam or two
_OCCLUDERS_TO_M = 55.0  # houses farther away hide little that is not far itself
_HIDDEN_M = 90.0  # what houses hide is placed as if it were so far away: hardly a beam finds it
_THROUGH_PANE = materials.MATERIALS[materials.GLASS].passes ** 2  # share of light that comes back from behind one
_PANE, _BLIND, _SHUTTER, _DOOR, _GARAGE, _GATEWAY = range(6)
_DEEP_M = np.array([0.14, 0.14, 0.05, 0.2, 0.25, 0.8])  # of each kind behind the face of the wall
_SILLS_TO_M = 22.0  # a sill stands out by less than a beam is wide, farther away
_CURTAINED = 0.45  # share of the panes
_SHUT = 0.6, 1.0  # shares of a house's windows with a blind or a board, at least and at most
_OPAQUE_ALBEDO = 0.3, 0.65  # of that
_DARKER = np.array([1.0, 1.0, 1.0, 0.6, 0.6, 1.0])  # of each kind: doors are darker


@dataclass(frozen=True, eq=False)
class Houses:
    """Houses with x along their fronts and the street on the side of -y; the origin is the middle of the floor.

    Args:
        poses: poses of the centres of the houses.
        length_m: size along the street.
        depth_m: size away from the street.
        height_m: height of the walls.
        storey_m: height of a storey; a garage has one storey.
        roof_m: height of the ridge above the walls; 0 for flat roofs.
        wall_material: index of brick, plaster or concrete.
        wall_albedo: albedo of the walls.
        plain: True for garages and sheds, which have no windows.
    """

    poses: Poses
    length_m: Float[np.ndarray, " n"]
    depth_m: Float[np.ndarray, " n"]
    height_m: Float[np.ndarray, " n"]
    storey_m: Float[np.ndarray, " n"]
    roof_m: Float[np.ndarray, " n"]
    wall_material: Int[np.ndarray, " n"]
    wall_albedo: Float[np.ndarray, " n"]
    plain: np.ndarray

    def nearest_approach_m(self, plan: StreetPlan, points_m: Num[np.ndarray, "p _"]) -> Float[np.ndarray, " p"]:
        """Return the smallest distance of our car from points; points that houses hide from it count as far."""
        away = plan.nearest_approach_m(points_m)
        hides = np.flatnonzero((plan.nearest_approach_m(self.poses.xyz_m) < _OCCLUDERS_TO_M) & ~self.plain)
        beside = np.flatnonzero((away > 12.0) & (away < _HIDDEN_M))
        # (houses, eyes): lines of sight in the frame of each house
        from_x, from_y = self._into(hides, plan.viewpoints_m)
        to_x, to_y = self._into(hides, points_m[beside, :2])
        spans = []
        with np.errstate(divide="ignore", invalid="ignore"):  # a line along a wall counts as free
            for start, end, size in ((from_x, to_x, self.length_m), (from_y, to_y, self.depth_m)):
                inverse, half = 1 / (end[:, :, None] - start[:, None]), (size[hides, None, None] / 2).astype(np.float32)
                middle, reach = -start[:, None] * inverse, half * abs(inverse)
                spans.append((middle - reach, middle + reach))
        enter, leave = np.maximum(spans[0][0], spans[1][0]), np.minimum(spans[0][1], spans[1][1])
        blocked = (enter < leave) & (enter > 0) & (leave < 1)  # a place in a house is not hidden by it
        away[beside[blocked.any(axis=0).all(axis=-1)]] = _HIDDEN_M
        return away

    def _into(self, which: np.ndarray, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return x and y (h, p) of points (p, 2) in the frames of some houses."""
        x, y = (points_m[:, axis] - self.poses.xyz_m[which, axis, None] for axis in (0, 1))
        cos, sin = np.cos(self.poses.yaw_rad[which, None]), np.sin(self.poses.yaw_rad[which, None])
        return (cos * x + sin * y).astype(np.float32), (cos * y - sin * x).astype(np.float32)


@dataclass(frozen=True, eq=False)
class _Walls:
    """Flat walls of houses: the house, where the wall begins and which way it runs (both in the house's frame)."""

    house: np.ndarray
    start: np.ndarray  # (w, 2)
    along: np.ndarray  # (w, 2), unit
    length: np.ndarray
    away: np.ndarray  # from our car's way
    glazed: np.ndarray


def add_houses(builder: MeshBuilder, rng: np.random.Generator, plan: StreetPlan, houses: Houses) -> None:
    """Add houses; walls that the sensor never sees are plain."""
    walls = _walls(plan, houses)
    _add_plain_walls(builder, houses, walls)
    _add_windows(builder, rng, houses, walls)
    _add_insides(builder, rng, houses, walls)
    _add_roofs(builder, rng, houses)
    _add_balconies(builder, rng, houses, walls)


def _walls(plan: StreetPlan, houses: Houses) -> _Walls:
    count = len(houses.length_m)
    half = np.stack((houses.length_m, houses.depth_m), axis=1) / 2
    start = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], float)[:, None] * half  # front, right, back, left
    along = np.repeat(np.array([(1, 0), (0, 1), (-1, 0), (0, -1)], float)[:, None], count, axis=1)
    length = np.stack((houses.length_m, houses.depth_m, houses.length_m, houses.depth_m))
    outward = np.stack((along[..., 1], -along[..., 0]), axis=-1)
    before = start + along * length[..., None] / 2 + outward  # a step before the middle of each wall
    cos, sin = np.cos(houses.poses.yaw_rad), np.sin(houses.poses.yaw_rad)
    turned = np.stack((cos * before[..., 0] - sin * before[..., 1], sin * before[..., 0] + cos * before[..., 1]), -1)
    away = houses.nearest_approach_m(plan, (turned + houses.poses.xyz_m[:, :2]).reshape(-1, 2))
    eyes = np.stack(houses._into(np.arange(count), plan.viewpoints_m), axis=-1)  # (n, k, 2)
    faces = (((eyes - start[:, :, None]) * outward[:, :, None]).sum(axis=3) > 0).any(axis=2)
    glazed = (faces & ~houses.plain).ravel() & (away < _WINDOWS_TO_M)
    return _Walls(
        np.tile(np.arange(count), 4), start.reshape(-1, 2), along.reshape(-1, 2), length.ravel(), away, glazed
    )


def _on_wall(
    houses: Houses, walls: _Walls, which: np.ndarray, along_m: np.ndarray, deep_m: np.ndarray, z_m: np.ndarray
) -> np.ndarray:
    """Return world coordinates (m, k, 3) of points on walls: along the wall, behind its face, and up."""
    along, start = walls.along[which][:, None], walls.start[which][:, None]
    inward = np.stack((-along[..., 1], along[..., 0]), axis=-1)
    flat = start + along * along_m[..., None] + inward * deep_m[..., None]
    local = np.concatenate((flat, np.broadcast_to(z_m, along_m.shape)[..., None]), axis=-1).astype(np.float32)
    return houses.poses.of(walls.house[which]).to_world(local)


def _add_wall_quads(builder: MeshBuilder, houses: Houses, walls: _Walls, which: np.ndarray, spans: np.ndarray) -> None:
    """Add rectangles of wall; spans has the columns from, to, bottom, top."""
    along, z = spans[:, [0, 1, 1, 0]], spans[:, [2, 2, 3, 3]]
    points = _on_wall(houses, walls, which, along, np.zeros_like(along), z)
    house = walls.house[which]
    builder.add(
        quads(points), houses.wall_material[house][:, None], houses.wall_albedo[house][:, None], classes.BUILDING
    )


def _add_plain_walls(builder: MeshBuilder, houses: Houses, walls: _Walls) -> None:
    """Add whole walls where there is no relief, and the foot of the others."""
    relief = walls.glazed & (walls.away < _RELIEF_TO_M)
    plain = np.flatnonzero(~relief)
    top = houses.height_m[walls.house]
    _add_wall_quads(builder, houses, walls, plain, rows_of(0.0, walls.length, -_SINK_M, top)[plain])
    foot = np.flatnonzero(relief)
    _add_wall_quads(builder, houses, walls, foot, rows_of(0.0, walls.length, -_SINK_M, 0.0)[foot])


def _add_windows(builder: MeshBuilder, rng: np.random.Generator, houses: Houses, walls: _Walls) -> None:
    """Divide walls into bays and storeys; each cell is a frame of wall round an opening, its reveal and its pane.

    Far cells are dark patches on a whole wall.
    """
    which = np.flatnonzero(walls.glazed)
    house = walls.house[which]
    taste = rng.uniform(2.0, 3.4, len(houses.length_m))  # width of a bay
    bays = np.maximum((walls.length[which] / taste[house]).round(), 1).astype(int)
    storeys = np.maximum((houses.height_m / houses.storey_m).round(), 1).astype(int)[house]
    cell, order = owners(bays * storeys)
    bay, storey = order % bays[cell], order // bays[cell]
    wall, home = which[cell], house[cell]
    width, height = walls.length[wall] / bays[cell], houses.height_m[home] / storeys[cell]
    left, low = bay * width, storey * height
    style = rng.uniform(0, 1, (3, len(houses.length_m)))[:, home]
    half_width = np.minimum(0.42 + 0.45 * style[0], width * 0.42)
    sill, head = 0.75 + 0.35 * style[1], 2.0 + 0.35 * style[2]
    chance = rng.random(len(cell))
    shop = (storey == 0) & (houses.storey_m[home] > 3.3) & (style[0] > 0.4)  # tall ground floors have large panes
    half_width, sill = np.where(shop, width * 0.42, half_width), np.where(shop, 0.4, sill)
    # Habits of a house: of KITTI's labelled walls 2 % read 0, so behind most windows that it sees are blinds or boards.
    shut = ~shop & (rng.random(len(cell)) < rng.uniform(*_SHUT, len(houses.length_m))[home])
    kind = np.where(chance < 0.16, _SHUTTER, np.where(shut, _BLIND, _PANE))
    ground, grand = storey == 0, (width > 2.5) & (houses.length_m[home] > 6)
    entry = rng.random(len(cell))
    door, garage = ground & (entry < 0.13) & ~shop, ground & grand & (entry > 0.93)
    gateway = ground & grand & (entry > 0.9) & ~garage & (houses.storey_m[home] > 2.8)
    kind = np.select([door, garage, gateway], [_DOOR, _GARAGE, _GATEWAY], kind)
    sill = np.where(kind >= _DOOR, 0.02, sill)
    half_width = np.select([door, garage | gateway], [0.55, np.minimum(1.3, width * 0.44)], half_width)
    head = np.select([door, garage | gateway], [2.15, 2.35], head)
    blind = (chance[::-1] > 0.84) & (kind < _DOOR)  # a cell without an opening
    near = walls.away[wall] < _RELIEF_TO_M
    span = rows_of(left, left + width, low, low + height)
    shut = near & blind
    _add_wall_quads(builder, houses, walls, wall[shut], span[shut])
    middle = left + width / 2
    hole = rows_of(middle - half_width, middle + half_width, low + sill, low + np.minimum(head, height - 0.1))
    open_, patch = np.flatnonzero(near & ~blind), np.flatnonzero(~near & ~blind)
    _add_cells(builder, rng, houses, walls, wall[open_], span[open_], hole[open_], kind[open_])
    _add_patches(builder, rng, houses, walls, wall[patch], hole[patch], kind[patch])
    low_cells = np.flatnonzero(near & ground)
    _add_foot(builder, rng, houses, walls, wall[low_cells], span[low_cells], hole[low_cells], kind[low_cells])
    ledge = np.flatnonzero(near & ~blind & (kind < _DOOR) & (walls.away[wall] < _SILLS_TO_M))
    sills = hole[ledge][:, [0, 1, 2, 2]] + np.array([-0.08, 0.08, -0.06, 0.0])
    _add_wall_blocks(builder, houses, walls, wall[ledge], sills, 0.08, materials.CONCRETE, 0.35)


def _add_wall_blocks(
    builder: MeshBuilder, houses: Houses, walls: _Walls, which: np.ndarray, spans: np.ndarray,
    out_m: float | np.ndarray, material: int | np.ndarray, albedo: float | np.ndarray,
) -> None:  # fmt: skip
    """Add blocks that stand out of walls; spans has the columns from, to, bottom, top."""
    along, z = spans[:, [0, 0, 0, 0, 1, 1, 1, 1]], spans[:, [2, 3, 2, 3, 2, 3, 2, 3]]
    outer = np.broadcast_to(-np.asarray(out_m, float).reshape(-1, 1), (len(spans), 1))
    deep = np.where(np.array([1, 1, 0, 0, 1, 1, 0, 0], bool), outer, 0.02)
    made, bright = (np.asarray(value).reshape(-1, 1) for value in (material, albedo))
    builder.add(blocks(_on_wall(houses, walls, which, along, deep, z)), made, bright, classes.BUILDING)


def _add_foot(
    builder: MeshBuilder, rng: np.random.Generator, houses: Houses, walls: _Walls, wall: np.ndarray, span: np.ndarray,
    hole: np.ndarray, kind: np.ndarray,
) -> None:  # fmt: skip
    """Add what a low sensor sees of walls: plinths with cellar windows, steps before doors, downpipes, a ledge above.

    The uppermost beam of an HDL-64E rises by 2 degrees: of a wall 20 m away it sees 2.4 m.
    """
    count = len(houses.length_m)
    tall, out = rng.uniform(0.25, 0.95, count), rng.uniform(0.02, 0.07, count)
    stone, bright = rng.choice([materials.CONCRETE, materials.BRICK], count), rng.uniform(0.2, 0.45, count)
    based = rng.random(count) < 0.65
    home = walls.house[wall]
    closed = np.flatnonzero(based[home] & (kind < _DOOR))
    cellar = closed[(rng.random(len(closed)) < 0.35) & (tall[home[closed]] > 0.5)]
    whole = np.setdiff1d(closed, cellar)
    middle, high = span[:, :2].mean(axis=1), tall[home]
    left, right, lintel = middle - 0.4, middle + 0.4, high - 0.12
    parts = [(whole, span[:, 0], span[:, 1], -0.3, high), (cellar, span[:, 0], left, -0.3, high),
             (cellar, right, span[:, 1], -0.3, high), (cellar, left, right, -0.3, 0.12),
             (cellar, left, right, lintel, high)]  # fmt: skip
    for some, *edges in parts:
        spans = np.column_stack([np.broadcast_to(edge, len(span)) for edge in edges])[some]
        house = home[some]
        _add_wall_blocks(builder, houses, walls, wall[some], spans, out[house], stone[house], bright[house])
    dark = rows_of(left, right, 0.12, lintel)[cellar]
    _add_wall_blocks(builder, houses, walls, wall[cellar], dark, 0.004, materials.PLASTER, 0.06)
    doors = np.flatnonzero((kind == _DOOR) & (rng.random(len(kind)) < 0.7))
    for level, reach in ((0.17, rng.uniform(0.3, 1.0, len(doors))), (0.34, rng.uniform(0.25, 0.3, len(doors)))):
        step = np.column_stack((hole[doors, :2] + np.array([-0.25, 0.25]), np.full((len(doors), 2), [-_SINK_M, level])))
        _add_wall_blocks(builder, houses, walls, wall[doors], step, reach, materials.CONCRETE, 0.3)
    once = np.unique(wall)
    piped = once[rng.random(len(once)) < 0.7]
    at = np.where(rng.random(len(piped)) < 0.5, 0.12, walls.length[piped] - 0.22)
    pipes = rows_of(at, at + 0.1, -0.2, houses.height_m[walls.house[piped]])
    _add_wall_blocks(builder, houses, walls, piped, pipes, 0.13, materials.METAL, 0.25)
    banded = once[(rng.random(count) < 0.25)[walls.house[once]]]
    storey = houses.storey_m[walls.house[banded]]
    band = rows_of(0.0, walls.length[banded], storey - 0.15, storey + 0.1)
    _add_wall_blocks(builder, houses, walls, banded, band, 0.1, materials.CONCRETE, 0.4)


def _add_patches(
    builder: MeshBuilder, rng: np.random.Generator, houses: Houses, walls: _Walls, wall: np.ndarray, hole: np.ndarray,
    kind: np.ndarray,
) -> None:  # fmt: skip
    """Add openings as flat patches before a whole wall, as bright as what is seen through a pane."""
    along, z = hole[:, [0, 1, 1, 0]], hole[:, [2, 2, 3, 3]]
    points = _on_wall(houses, walls, wall, along, np.full(along.shape, -0.03), z)
    room = np.where(rng.random(len(kind)) < _CURTAINED, rng.uniform(0.25, 0.6, len(kind)), 0.09)
    bright = np.where(kind == _PANE, room * _THROUGH_PANE, rng.uniform(*_OPAQUE_ALBEDO, len(kind)) * _DARKER[kind])
    material = np.where(np.isin(kind, (_DOOR, _GARAGE)), materials.PAINT, materials.PLASTER)
    builder.add(quads(points), material[:, None], bright[:, None], classes.BUILDING)


def _add_cells(
    builder: MeshBuilder,
    rng: np.random.Generator,
    houses: Houses,
    walls: _Walls,
    wall: np.ndarray,
    span: np.ndarray,
    hole: np.ndarray,
    kind: np.ndarray,
) -> None:
    frame = [
        np.stack((span[:, 0], span[:, 1], span[:, 2], hole[:, 2]), axis=1),
        np.stack((span[:, 0], span[:, 1], hole[:, 3], span[:, 3]), axis=1),
        np.stack((span[:, 0], hole[:, 0], hole[:, 2], hole[:, 3]), axis=1),
        np.stack((hole[:, 1], span[:, 1], hole[:, 2], hole[:, 3]), axis=1),
    ]
    _add_wall_quads(builder, houses, walls, np.tile(wall, 4), np.concatenate(frame))
    house = walls.house[wall]
    deep = _DEEP_M[kind][:, None]
    along, z = hole[:, [0, 1, 1, 0]], hole[:, [2, 2, 3, 3]]
    outer, inner = (_on_wall(houses, walls, wall, along, np.broadcast_to(d, along.shape), z) for d in (deep * 0, deep))
    reveal = np.stack((outer, np.roll(outer, -1, 1), np.roll(inner, -1, 1), inner), axis=2)
    material, albedo = houses.wall_material[house][:, None, None], houses.wall_albedo[house][:, None, None]
    builder.add(quads(reveal), material, albedo, classes.BUILDING)
    filling = np.array([materials.GLASS, *(materials.PLASTER,) * 2, *(materials.PAINT,) * 2, materials.PLASTER])[kind]
    opaque = rng.uniform(*_OPAQUE_ALBEDO, len(kind)) * _DARKER[kind]
    bright = np.where(kind == _PANE, 0.02, np.where(kind == _GATEWAY, 0.05, opaque))
    builder.add(quads(inner), filling[:, None], bright[:, None], classes.BUILDING)
    curtain = np.flatnonzero((kind == _PANE) & (rng.random(len(kind)) < _CURTAINED))  # cloth close behind the pane
    along, z = along[curtain], z[curtain]
    points = _on_wall(houses, walls, wall[curtain], along, np.full(along.shape, 0.25), z)
    builder.add(quads(points), materials.CLOTH, rng.uniform(0.25, 0.6, (len(curtain), 1)), classes.BUILDING)


def _add_insides(builder: MeshBuilder, rng: np.random.Generator, houses: Houses, walls: _Walls) -> None:
    """Stand dark inner walls behind the windows."""
    opened = (walls.glazed & (walls.away < _RELIEF_TO_M)).reshape(4, -1).any(axis=0)
    half = np.stack((houses.length_m, houses.depth_m), axis=1) / 2 - 0.9
    some = np.flatnonzero(opened & (half.min(axis=1) > 0.5))
    half, top = half[some], houses.height_m[some] - 0.1
    inner = boxes(rows_of(-half[:, 0], -half[:, 1], -0.2), rows_of(half[:, 0], half[:, 1], top))
    dark = rng.uniform(0.03, 0.15, (len(some), 1))
    builder.add(houses.poses.of(some).to_world(inner[:, :8]), materials.PLASTER, dark, classes.BUILDING)


def _add_roofs(builder: MeshBuilder, rng: np.random.Generator, houses: Houses) -> None:
    """Add saddle roofs with eaves, their gables, and flat lids."""
    out = np.where(houses.roof_m > 0, 0.35, 0.02)
    half_length, half_depth = houses.length_m / 2 + out, houses.depth_m / 2 + out
    low, ridge = houses.height_m, houses.height_m + houses.roof_m + 0.02
    hip = np.where(rng.random(len(low)) < 0.25, houses.depth_m / 2, 0.0) * (houses.length_m > houses.depth_m * 1.1)
    corner = [rows_of(a * half_length, b * half_depth, low) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    tops = [rows_of(a * (half_length - hip), 0.0, ridge) for a in (-1, 1)]
    slopes = np.stack(
        [
            np.stack((corner[0], corner[1], tops[1], tops[0]), axis=1),
            np.stack((corner[2], corner[3], tops[0], tops[1]), axis=1),
        ],
        axis=1,
    )
    tiles = houses.poses.to_world(quads(slopes))
    bright = rng.uniform(0.12, 0.35, (len(low), 1, 1))
    builder.add(tiles, materials.BRICK, bright, classes.BUILDING)
    ends = np.stack(
        [np.stack((corner[1], corner[2], tops[1]), axis=1), np.stack((corner[3], corner[0], tops[0]), axis=1)], axis=1
    )
    gable = houses.poses.to_world(ends.astype(np.float32))
    builder.add(gable, houses.wall_material[:, None], houses.wall_albedo[:, None], classes.BUILDING)


def _add_balconies(builder: MeshBuilder, rng: np.random.Generator, houses: Houses, walls: _Walls) -> None:
    """Hang balconies on some fronts, and add bays that break the plane."""
    count = len(houses.length_m)
    front = (walls.glazed & (walls.away < _BALCONIES_TO_M))[:count]
    many = np.where(front, rng.poisson(1.6, count), 0)
    home, _ = owners(many)
    x = rng.uniform(-0.5, 0.5, len(home)) * np.maximum(houses.length_m[home] - 4.0, 0.5)
    face = -houses.depth_m[home] / 2
    kind = rng.random(len(home))
    storey = np.minimum(np.floor(rng.random(len(home)) * 3) + 1, np.round(houses.height_m / houses.storey_m)[home] - 1)
    half, out = rng.uniform(0.8, 1.8, len(home)), rng.uniform(0.6, 1.5, len(home))
    material, albedo = houses.wall_material[home], houses.wall_albedo[home]
    hung = np.flatnonzero((kind < 0.5) & (storey > 0))
    floor = storey * houses.storey_m[home]
    slab = boxes(rows_of(x - half, face - out, floor - 0.15), rows_of(x + half, face, floor))
    rail = boxes(rows_of(x - half, face - out, floor), rows_of(x + half, face - out + 0.06, floor + 0.95))
    balcony = houses.poses.of(home[hung]).to_world(np.stack((slab, rail), axis=1)[hung])
    builder.add(balcony, materials.CONCRETE, albedo[hung][:, None, None], classes.BUILDING)
    bays = np.flatnonzero((kind > 0.5) & (kind < 0.75))
    tall = houses.height_m[home] * np.where(half > 1.2, 1.0, 0.45)
    bay = boxes(rows_of(x - half, face - out * 0.6, -_SINK_M), rows_of(x + half, face + 0.05, tall))[bays]
    bay = houses.poses.of(home[bays]).to_world(bay)
    builder.add(bay, material[bays][:, None], albedo[bays][:, None], classes.BUILDING)
