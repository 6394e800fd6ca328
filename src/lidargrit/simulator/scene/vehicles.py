"""Cars, vans and trucks: kinds and places → bodies lofted over cross-sections, with glass, wheels and plates."""

import numpy as np
from jaxtyping import Float, Int

from lidargrit.scans import classes
from lidargrit.simulator import materials
from lidargrit.simulator.scene.objects import ObjectBatch, Placements
from lidargrit.simulator.scene.shapes import boxes, fans, loft, quads, rows_of, tubes

HATCHBACK, SALOON, ESTATE, SUV, VAN, TRUCK = range(6)
_SIZE_M = np.array(  # length, width, height: middle of the class; after data sheets of common cars, in round numbers
    [(4.05, 1.74, 1.48), (4.60, 1.80, 1.45), (4.65, 1.80, 1.48), (4.45, 1.85, 1.68), (5.2, 1.95, 2.1), (7.6, 2.4, 2.6)]
)
_SPREAD = np.array([(0.07, 0.02, 0.03)] * 4 + [(0.1, 0.02, 0.12), (0.12, 0.02, 0.05)])
# Fourteen cross-sections: share of the length behind the nose, and of the height at the roof or bonnet line.
_BEHIND_NOSE = np.array(
    [
        (0, 0.02, 0.08, 0.20, 0.27, 0.44, 0.50, 0.545, 0.58, 0.74, 0.86, 0.965, 0.985, 1),
        (0, 0.02, 0.08, 0.20, 0.27, 0.42, 0.47, 0.515, 0.545, 0.64, 0.70, 0.84, 0.97, 1),
        (0, 0.02, 0.07, 0.18, 0.25, 0.39, 0.45, 0.50, 0.53, 0.74, 0.91, 0.975, 0.99, 1),
        (0, 0.02, 0.06, 0.18, 0.24, 0.36, 0.42, 0.48, 0.515, 0.74, 0.91, 0.975, 0.99, 1),
        (0, 0.02, 0.05, 0.11, 0.14, 0.27, 0.32, 0.36, 0.40, 0.60, 0.97, 0.985, 0.99, 1),
        (0, 0.01, 0.015, 0.02, 0.03, 0.06, 0.09, 0.14, 0.18, 0.21, 0.24, 0.25, 0.60, 1),
    ]
)
_TOP = np.array(
    [
        (0.36, 0.50, 0.58, 0.64, 0.67, 0.95, 1, 1, 1, 0.98, 0.93, 0.66, 0.56, 0.38),
        (0.38, 0.50, 0.58, 0.64, 0.67, 0.95, 1, 1, 1, 0.99, 0.96, 0.70, 0.66, 0.42),
        (0.38, 0.50, 0.58, 0.64, 0.67, 0.95, 1, 1, 1, 1, 0.96, 0.68, 0.56, 0.40),
        (0.42, 0.55, 0.62, 0.66, 0.68, 0.95, 1, 1, 1, 1, 0.97, 0.66, 0.58, 0.42),
        (0.30, 0.40, 0.48, 0.54, 0.57, 0.94, 0.99, 1, 1, 1, 0.99, 0.97, 0.90, 0.25),
        (0.34, 0.42, 0.48, 0.50, 0.52, 0.92, 0.95, 0.95, 0.95, 0.95, 0.93, 0.32, 0.32, 0.30),
    ]
)
_BELT = np.array([0.64, 0.65, 0.65, 0.66, 0.55, 0.50])
_FULLNESS = np.array([0.74, 0.88, 0.96, 1, 1, 1, 1, 1, 1, 1, 0.99, 0.96, 0.91, 0.80])  # of the width, from above
_WINDSCREEN, _REAR_SCREEN, _SIDE_PANES = 4, 10, (5, 6, 8, 9)
# Farther away some sections, and the sill, middle, belt and roof of each, tell the same.
_FAR_SECTIONS, _FAR_POINTS, _FAR_FACES = (0, 1, 4, 5, 8, 10, 11, 12, 13), (1, 2, 3, 4), (0, 2, 3, 5, 7, 8, 9, 11)
_DETAIL_TO_M = 27.0  # beams lie 0.1 by 0.2 m apart there: wheels and seats are a pixel or two
_AXLES = np.array([(0.19, 0.80)] * 4 + [(0.17, 0.78), (0.13, 0.76)])
_LABELS = np.array([classes.CAR] * 5 + [classes.TRUCK])
_MOVING = np.array([classes.MOVING_CAR] * 5 + [classes.MOVING_TRUCK])


def sample_vehicle_kinds(rng: np.random.Generator, count: int, trucks: float = 0.03) -> Int[np.ndarray, " n"]:
    """Sample what kinds of vehicle stand or drive in a European street."""
    shares = np.array([0.36, 0.2, 0.22, 0.12, 0.10, 0.0]) * (1 - trucks)
    shares[TRUCK] = trucks
    return rng.choice(6, count, p=shares)


def make_vehicles(
    rng: np.random.Generator,
    kinds: Int[np.ndarray, " n"],
    placements: Placements,
    first_instance: int,
    away_m: Float[np.ndarray, " n"],
) -> list[ObjectBatch]:
    """Sample vehicles of given kinds; far ones are cruder, and trucks come with a box that is an object of its own."""
    count = len(kinds)
    size = _SIZE_M[kinds] * (1 + _SPREAD[kinds] * np.clip(rng.normal(size=(count, 3)), -1.6, 1.6))
    length, width, height = size.T
    dark = rng.random(count) < 0.5
    paint = np.where(dark, np.exp(rng.uniform(np.log(0.002), np.log(0.05), count)), rng.uniform(0.05, 0.4, count))
    seats, metal = rng.uniform(0.03, 0.12, (count, 1)), rng.uniform(0.1, 0.4, (count, 1))
    instance = np.arange(first_instance, first_instance + count, dtype=np.int32)
    label = np.where(placements.speed_m_s != 0, _MOVING[kinds], _LABELS[kinds])
    groups = []
    for far in (False, True):
        some = np.flatnonzero((away_m > _DETAIL_TO_M) == far)
        if not len(some):
            continue
        kind, (long, wide, tall) = kinds[some], size[some].T
        body, glazed = _body(kind, long, wide, tall, far)
        parts = [
            (body, np.where(glazed, materials.GLASS, materials.PAINT), np.where(glazed, 0.02, paint[some, None])),
            (_plates(long, wide), materials.FOIL, 0.5),
            (_wheels(kind, long, wide, tall, far), materials.RUBBER, 0.03),
            (_inside(kind, long, wide, tall, far), materials.CLOTH, seats[some]),
            (_rims(kind, long, wide, tall, far), materials.METAL, metal[some]),
        ]
        groups.append(_object_batch(parts, label[some], instance[some], placements.select(some)))
    trucks = np.flatnonzero(kinds == TRUCK)
    if len(trucks):
        high = np.maximum(height[trucks] * rng.uniform(1.05, 1.45, len(trucks)), 2.6)
        half, nose = width[trucks] / 2 + 0.06, length[trucks] / 2
        cargo = boxes(rows_of(-nose, -half, 0.9), rows_of(nose - 0.26 * length[trucks], half, high))
        part = (cargo, materials.PAINT, rng.uniform(0.1, 0.5, (len(trucks), 1)))
        groups.append(_object_batch([part], label[trucks], instance[trucks], placements.select(trucks)))
    return groups


def _object_batch(parts: list[tuple], label: np.ndarray, instance: np.ndarray, placements: Placements) -> ObjectBatch:
    shapes = [part[0].shape[:2] for part in parts]
    local = np.concatenate([part[0] for part in parts], axis=1)
    material = np.concatenate([np.broadcast_to(p[1], s) for p, s in zip(parts, shapes, strict=True)], axis=1)
    albedo = np.concatenate([np.broadcast_to(p[2], s) for p, s in zip(parts, shapes, strict=True)], axis=1)
    labelled = np.broadcast_to(label[:, None], local.shape[:2])
    return ObjectBatch(
        local.astype(np.float32),
        material.astype(np.uint8),
        albedo.astype(np.float32),
        labelled.astype(np.uint16),
        instance,
        placements,
    )


def _body(
    kinds: np.ndarray, length: np.ndarray, width: np.ndarray, height: np.ndarray, far: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the skins (n, t, 3, 3), nose at +x, and which of their triangles are glass."""
    count = len(kinds)
    x = length[:, None] * (0.5 - _BEHIND_NOSE[kinds])  # (n, 14)
    top = height[:, None] * _TOP[kinds]
    belt = np.minimum((height * _BELT[kinds])[:, None], top - 0.04)
    half = width[:, None] / 2 * _FULLNESS
    boxy = kinds[:, None] >= VAN
    cabin = top > belt + 0.08
    roof_half = half * np.where(cabin, np.where(boxy, 0.88, 0.75), 0.86)
    low = np.full_like(x, 0.2) + 0.12 * boxy + np.where(np.arange(14) % 13 == 0, 0.12, 0.0)
    edge = np.where(cabin, 0.05, 0.015)
    profile = [  # half a cross-section, from the sill up: y and z
        (0.90 * half, low),
        (0.99 * half, low + 0.14),
        (half, (belt + low) / 2),
        (0.965 * half, belt),
        (roof_half, top - edge),
        (0.5 * roof_half, top),
    ]
    if far:
        profile[1], profile[4] = (0.99 * half, low), (roof_half, top)
        profile = [profile[point] for point in _FAR_POINTS]
    left = np.stack([np.stack((x, y, z), axis=-1) for y, z in profile], axis=2)  # (n, 14, 6, 3)
    right = left[:, :, ::-1] * np.array([1, -1, 1])
    rings = np.concatenate((left, right), axis=2)
    glass = np.zeros((count, 13, 12), bool)
    glass[:, _WINDSCREEN, 4:7] = True
    glass[:, _REAR_SCREEN, 4:7] = (kinds < VAN)[:, None]
    for pane in _SIDE_PANES:
        glass[:, pane, 3:8:4] = ((kinds < VAN) | (pane < 7))[:, None]
    if far:
        rings = rings[:, _FAR_SECTIONS]
        glass = glass[:, _FAR_SECTIONS[:-1]][:, :, _FAR_FACES]
    skin, ends = loft(rings)[:, :, :-1], fans(rings[:, [0, -1]])  # nobody looks at cars from below
    glass = np.repeat(glass[:, :, :-1].reshape(count, -1), 2, axis=1)
    body = np.concatenate((skin.reshape(count, -1, 3, 3), ends.reshape(count, -1, 3, 3)), axis=1)
    return body, np.pad(glass, ((0, 0), (0, body.shape[1] - glass.shape[1])))


def _inside(kinds: np.ndarray, length: np.ndarray, width: np.ndarray, height: np.ndarray, far: bool) -> np.ndarray:
    """Return what is seen through the glass: a block up to the belt, and a row of seats or two."""
    belt = _BELT[kinds] * height
    half, short = width * 0.42, kinds == TRUCK
    front, back = length * np.where(short, 0.46, 0.24), -length * np.where(short, -0.28, 0.36)
    floor = boxes(rows_of(back, -half, 0.4), rows_of(front, half, belt - 0.1))
    seat = np.where(short, 0.36 * length, np.where(kinds == VAN, 0.19 * length, -0.03 * length))
    top = belt + 0.55 * (height - belt)
    first = boxes(rows_of(seat - 0.15, -half * 0.8, belt - 0.2), rows_of(seat, half * 0.8, top))
    second = seat - np.where(kinds >= VAN, 0.05, 0.9)
    rear = boxes(rows_of(second - 0.15, -half * 0.8, belt - 0.2), rows_of(second, half * 0.8, top - 0.05))
    if far:  # the top of the block and one face of each row
        return np.concatenate((floor[:, 10:], first[:, :2], rear[:, :2]), axis=1)
    return np.concatenate((floor, first, rear), axis=1)


def _plates(length: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Return number plates, 0.52 x 0.11 m as in Europe, just before the nose and behind the tail."""
    faces = []
    for end, low in ((1, 0.42), (-1, 0.62)):
        x = end * (length / 2 + 0.015)
        corners = [rows_of(x, y, z) for y, z in ((-0.26, low), (0.26, low), (0.26, low + 0.11), (-0.26, low + 0.11))]
        faces.append(quads(np.stack(corners, axis=1)))
    return np.concatenate(faces, axis=1)


def _hubs(
    kinds: np.ndarray, length: np.ndarray, width: np.ndarray, height: np.ndarray, out_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the middles (n, 4, 3) of discs ``out_m`` outside the body, one for each wheel, and the wheels' radii."""
    radius = np.where(kinds == TRUCK, 0.46, np.clip(0.21 * height, 0.29, 0.36))
    hubs = np.empty((len(kinds), 4, 3))
    hubs[..., 0] = (length[:, None] * (0.5 - _AXLES[kinds]))[:, [0, 0, 1, 1]]
    hubs[..., 1] = (width / 2 + out_m)[:, None] * np.array([-1, 1, -1, 1])
    hubs[..., 2] = radius[:, None]
    return hubs, radius


def _wheels(kinds: np.ndarray, length: np.ndarray, width: np.ndarray, height: np.ndarray, far: bool) -> np.ndarray:
    outer, radius = _hubs(kinds, length, width, height, 0.01)
    if far:
        return fans(_rounds(outer, radius, 6)).reshape(len(kinds), -1, 3, 3)
    inner, _ = _hubs(kinds, length, width, height, -0.22)
    every = np.repeat(radius, 4)
    tyres = tubes(inner.reshape(-1, 3), outer.reshape(-1, 3), every, every, sides=10)
    return tyres.reshape(len(kinds), -1, 3, 3)


def _rims(kinds: np.ndarray, length: np.ndarray, width: np.ndarray, height: np.ndarray, far: bool) -> np.ndarray:
    hubs, radius = _hubs(kinds, length, width, height, 0.018)
    discs = _rounds(hubs, 0.74 * radius, 4) if far else _rounds(hubs, 0.62 * radius, 8)  # of nearly the same area
    return fans(discs).reshape(len(kinds), -1, 3, 3)


def _rounds(middle: np.ndarray, radius: np.ndarray, corners: int) -> np.ndarray:
    """Return upright rims (n, 4, corners, 3) that face sideways."""
    turn = 2 * np.pi / corners * np.arange(corners)
    rim = np.stack((np.cos(turn), 0 * turn, np.sin(turn)), axis=1)
    return middle[:, :, None] + radius[:, None, None, None] * rim
