"""Echoes of beams of finite width: beams in a scene → one echo a pixel, of one surface or a mixture."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64

from lidargrit.scans.sensors import SensorSetup
from lidargrit.simulator.beams import footprint
from lidargrit.simulator.power import RaydropModel, Surfaces, received_power
from lidargrit.simulator.tracing import NOTHING, Hits, Tracer

_FAR_M = 1e6  # stands for infinity where ranges are subtracted


@dataclass(frozen=True, eq=False)
class Echoes:
    """The strongest echo of each beam.

    Args:
        power: received power.
        range_m: noise-free range of the echo; infinite for none.
        triangle: index of the triangle that contributes most of the light, or NOTHING.
        cos_incidence: cosine of incidence at that triangle.
    """

    power: Float32[np.ndarray, " n"]
    range_m: Float32[np.ndarray, " n"]
    triangle: Int32[np.ndarray, " n"]
    cos_incidence: Float32[np.ndarray, " n"]


def edges(
    range_m: Float32[np.ndarray, "H W"],
    left_m: Float32[np.ndarray, "H W"],
    right_m: Float32[np.ndarray, "H W"],
    edge_share: float,
) -> Bool[np.ndarray, "H W"]:
    """Find the pixels at which a surface ends or folds: there inverse range bends, which on a plane it does not.

    Args:
        range_m: range of each pixel; infinite for no hit.
        edge_share: relative bend of inverse range that makes an edge.
    """
    inverse, left, right = (1 / a for a in (range_m, left_m, right_m))
    bend = np.abs(2 * inverse - left - right)
    edge = bend > np.float32(edge_share) * np.maximum(np.maximum(left, right), inverse)
    if len(inverse) > 2:
        above, middle, below = inverse[:-2], inverse[1:-1], inverse[2:]
        bend = np.abs(2 * middle - above - below)
        edge[1:-1] |= bend > np.float32(edge_share) * np.maximum(np.maximum(above, below), middle)
    return edge


def detect_echoes(
    tracer: Tracer,
    surfaces: Surfaces,
    rays: tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]],
    first: Hits,
    edge: Bool[np.ndarray, " n"],
    model: RaydropModel,
    setup: SensorSetup,
) -> Echoes:
    """Find the strongest echo of every beam, given what the middle of each meets first.

    Where a beam meets glass, what stands behind answers too, its light taken twice by every pane. At edges the beam's
    width counts: four more rays are cast, and each carries a fifth of the light. Echoes that are closer to one
    another than the pulse is long are heard as one, at their mean range. A beam that is split between surfaces farther
    apart loses power besides: the pulse that comes back is not the one that the sensor looks for.

    Args:
        tracer: ray caster of the scene.
        surfaces: reflection properties of the scene's triangles.
        rays: origins and directions of the beams.
        first: first hits of the central rays.
        edge: True for beams that are cast in their full width.
    """
    power = _power(surfaces, first, model)
    echoes = Echoes(power, first.range_m.copy(), first.triangle.copy(), first.cos_incidence.copy())
    passing = surfaces.passing()
    several = np.flatnonzero(edge | (passing > 0)[first.triangle])
    if len(several) == 0:
        return echoes
    origins, directions, wide = rays[0][several], rays[1][several], edge[several]
    middle = Hits(first.range_m[several], first.triangle[several], first.cos_incidence[several])
    behind, light = tracer.cast_through(origins, directions, middle, passing)
    light[light == 1] = 0  # no pane was there, and no second echo
    corners = _corners(tracer, origins, directions, wide, setup.divergence_mrad)
    parts = (middle, behind, *corners)
    powers = np.stack([_power(surfaces, part, model) for part in parts])
    powers[1] *= light
    powers[:, wide] *= np.float32(1 / (1 + len(corners)))
    split = wide & (light == 0)  # behind a pane nothing is known of the other parts
    _answer_strongest(echoes, several, powers, parts, split, setup)
    return echoes


def _power(surfaces: Surfaces, hits: Hits, model: RaydropModel) -> Float32[np.ndarray, " n"]:
    return received_power(surfaces.brightness(hits.triangle, hits.cos_incidence), hits.range_m, model)


def _corners(
    tracer: Tracer,
    origins_m: Float32[np.ndarray, "n 3"],
    directions: Float32[np.ndarray, "n 3"],
    wide: Bool[np.ndarray, " n"],
    divergence_mrad: float,
) -> list[Hits]:
    """Cast the four corners of those beams whose width counts; the others' meet nothing."""
    corners = footprint(directions[wide], divergence_mrad / 1e3)
    found = tracer.cast(np.concatenate([origins_m[wide]] * len(corners)), corners.reshape(-1, 3))
    hits = []
    for part in range(len(corners)):
        own = slice(part * corners.shape[1], (part + 1) * corners.shape[1])
        range_m, triangle = np.full(len(wide), np.inf, np.float32), np.full(len(wide), NOTHING, np.int32)
        cos = np.zeros(len(wide), np.float32)
        range_m[wide], triangle[wide], cos[wide] = (found.range_m[own], found.triangle[own], found.cos_incidence[own])
        hits.append(Hits(range_m, triangle, cos))
    return hits


def _answer_strongest(
    echoes: Echoes,
    several: Int64[np.ndarray, " n"],
    powers: Float32[np.ndarray, "parts n"],
    parts: tuple[Hits, ...],
    split: Bool[np.ndarray, " n"],
    setup: SensorSetup,
) -> None:
    """Write into echoes, for the beams that have several, the strongest group of those a pulse's length apart.

    Args:
        parts: hits of the middle, of what is behind a pane, and of the corners.
        split: True for beams whose parts on other surfaces weaken the group.
    """
    range_m = np.minimum(np.stack([part.range_m for part in parts]), np.float32(_FAR_M))
    beam = np.arange(len(several))
    best, group = np.full(len(several), -1, np.float32), powers
    heard_parts = np.zeros(range_m.shape, bool)
    for one in range_m:  # its group: those that are heard together with it
        near = np.abs(range_m - one) < np.float32(setup.pulse_length_m)
        together = np.where(near, powers, np.float32(0))
        total = together.sum(axis=0)
        group = np.where(total > best, together, group)
        heard_parts = np.where(total > best, near, heard_parts)
        best = np.maximum(best, total)
    heard = best > 0
    member = group.argmax(axis=0)
    mean_m = (group * range_m).sum(axis=0) / np.where(heard, best, 1)
    of_beam = (range_m < _FAR_M) & (np.arange(len(range_m)) != 1)[:, None]  # what is behind a pane is no part of it
    share = (of_beam & heard_parts).sum(axis=0) / np.maximum(of_beam.sum(axis=0), 1)
    echoes.power[several] = np.where(split, best * share.astype(np.float32) ** np.float32(setup.split_exponent), best)
    # Where nothing answers, the middle of the beam still says what stands there.
    echoes.range_m[several] = np.where(heard, mean_m, echoes.range_m[several])
    for name in ("triangle", "cos_incidence"):
        of_parts = np.stack([getattr(part, name) for part in parts])[member, beam]
        getattr(echoes, name)[several] = np.where(heard, of_parts, getattr(echoes, name)[several])
