"""People on foot and on bicycles: sizes and positions → limbs, wheels and frames."""

import numpy as np

from lidargrit.scans import classes
from lidargrit.simulator import materials
from lidargrit.simulator.scene.objects import ObjectBatch, Placements
from lidargrit.simulator.scene.shapes import quads, tubes

# Limbs of somebody 1 m tall: start, end (x ahead, y left, z up), radii there, 1 where skin shows.
_WALKER = np.array(
    [
        (0.00, 0.05, 0.51, 0.10, 0.05, 0.00, 0.050, 0.028, 0),
        (0.00, -0.05, 0.51, -0.12, -0.05, 0.01, 0.050, 0.028, 0),
        (0.00, 0.00, 0.48, 0.01, 0.00, 0.82, 0.085, 0.105, 0),
        (0.01, 0.12, 0.80, -0.06, 0.14, 0.48, 0.030, 0.022, 0),
        (0.01, -0.12, 0.80, 0.08, -0.14, 0.49, 0.030, 0.022, 0),
        (0.01, 0.00, 0.82, 0.01, 0.00, 0.87, 0.035, 0.055, 1),
        (0.01, 0.00, 0.87, 0.01, 0.00, 1.00, 0.058, 0.040, 1),
    ]
)
_RIDER = np.array(
    [
        (-0.10, 0.05, 0.56, 0.10, 0.06, 0.42, 0.050, 0.040, 0),
        (0.10, 0.06, 0.42, 0.06, 0.06, 0.14, 0.040, 0.028, 0),
        (-0.10, -0.05, 0.56, 0.06, -0.06, 0.36, 0.050, 0.035, 0),
        (0.06, -0.06, 0.36, 0.00, -0.06, 0.08, 0.035, 0.028, 0),
        (-0.12, 0.00, 0.54, 0.04, 0.00, 0.86, 0.085, 0.100, 0),
        (0.04, 0.12, 0.84, 0.26, 0.14, 0.62, 0.030, 0.020, 0),
        (0.04, -0.12, 0.84, 0.26, -0.14, 0.62, 0.030, 0.020, 0),
        (0.07, 0.00, 0.88, 0.08, 0.00, 1.02, 0.058, 0.045, 1),
    ]
)
_FRAME = np.array(  # metres: start, end, radii
    [
        (-0.52, 0, 0.34, -0.05, 0, 0.30, 0.02, 0.02),
        (-0.05, 0, 0.30, 0.38, 0, 0.72, 0.025, 0.025),
        (-0.15, 0, 0.75, 0.36, 0, 0.80, 0.022, 0.022),
        (-0.05, 0, 0.30, -0.18, 0, 0.92, 0.022, 0.022),
        (0.52, 0, 0.34, 0.36, 0, 1.0, 0.022, 0.022),
        (0.36, -0.27, 1.0, 0.36, 0.27, 1.0, 0.018, 0.018),
        (-0.30, 0, 0.95, -0.06, 0, 0.93, 0.06, 0.05),
    ]
)


def make_walkers(rng: np.random.Generator, placements: Placements, first_instance: int) -> ObjectBatch:
    """Sample people on foot, 1 to 1.95 m tall, most of them grown up."""
    tall = np.where(rng.random(len(placements)) < 0.12, rng.uniform(1.0, 1.5, len(placements)), 0.0)
    tall = np.where(tall > 0, tall, rng.normal(1.72, 0.08, len(placements)).clip(1.5, 1.95))
    label = np.where(placements.speed_m_s != 0, classes.MOVING_PERSON, classes.PERSON)
    limbs, material, albedo = _limbs(rng, _WALKER, tall, rng.uniform(0.9, 1.25, len(placements)))
    return _object_batch(limbs, material, albedo, label, placements, first_instance)


def make_cyclists(
    rng: np.random.Generator, placements: Placements, first_instance: int, ridden: bool = True
) -> ObjectBatch:
    """Sample bicycles with somebody on them, or without."""
    count = len(placements)
    bicycle, material, albedo = _bicycles(rng, count)
    if not ridden:
        return _object_batch(bicycle, material, albedo, np.full(count, classes.BICYCLE), placements, first_instance)
    rider, cloth, bright = _limbs(rng, _RIDER, rng.normal(1.75, 0.07, count), np.ones(count))
    rider[..., 2] += np.float32(0.06)
    label = np.where(placements.speed_m_s != 0, classes.MOVING_BICYCLIST, classes.BICYCLIST)
    pairs = ((bicycle, rider), (material, cloth), (albedo, bright))
    local, made_of, shade = (np.concatenate(pair, axis=1) for pair in pairs)
    return _object_batch(local, made_of, shade, label, placements, first_instance)


def _object_batch(
    local: np.ndarray, material: np.ndarray, albedo: np.ndarray, label: np.ndarray, placements: Placements, first: int
) -> ObjectBatch:
    every = np.broadcast_to(label[:, None], local.shape[:2]).astype(np.uint16)
    instance = np.arange(first, first + len(local), dtype=np.int32)
    return ObjectBatch(
        local.astype(np.float32), material.astype(np.uint8), albedo.astype(np.float32), every, instance, placements
    )


def _limbs(
    rng: np.random.Generator, table: np.ndarray, tall_m: np.ndarray, stout: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    count, parts = len(tall_m), len(table)
    mirror = np.array([1.0, 1.0, 1.0]) * np.where(rng.random(count) < 0.5, 1, -1)[:, None] ** np.array([0, 1, 0])
    start, end = (
        (table[None, :, at : at + 3] * (tall_m[:, None, None] * mirror[:, None])).reshape(-1, 3) for at in (0, 3)
    )
    thick, thin = ((table[None, :, at] * (tall_m * stout)[:, None]).ravel() for at in (6, 7))
    limbs = tubes(start, end, thick, thin)
    each = limbs.shape[1]
    limbs = limbs.reshape(count, parts * each, 3, 3)
    skin = np.repeat(table[:, 8] > 0, each)
    wear = rng.uniform(0.05, 0.6, (count, parts))
    wear[:, 1] = wear[:, 0]  # trousers of one cloth
    bright = np.where(skin, 0.45, np.repeat(wear, each, axis=1))
    return limbs, np.broadcast_to(np.where(skin, materials.SKIN, materials.CLOTH), bright.shape), bright


def _bicycles(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    turn = 2 * np.pi / 14 * np.arange(15)
    rims = []
    for x in (-0.52, 0.52):
        outer, inner = (
            np.stack((x + r * np.cos(turn), 0 * turn, 0.34 + r * np.sin(turn)), axis=1) for r in (0.34, 0.29)
        )
        rims.append(quads(np.stack((outer[:-1], outer[1:], inner[1:], inner[:-1]), axis=1)).reshape(-1, 3, 3))
    frame = tubes(_FRAME[:, :3], _FRAME[:, 3:6], _FRAME[:, 6], _FRAME[:, 7], sides=4).reshape(-1, 3, 3)
    one = np.concatenate((*rims, frame))
    tyres = len(one) - len(frame)
    material = np.repeat([materials.RUBBER, materials.PAINT], [tyres, len(frame)])
    albedo = np.where(np.arange(len(one)) < tyres, 0.05, rng.uniform(0.03, 0.4, (count, 1)))
    return np.repeat(one[None], count, axis=0), np.broadcast_to(material, albedo.shape), albedo
