"""Where beams meet a street: rays and a :class:`Street` → the first hit of every ray.

A ray is followed by its horizontal way w: it is at the height w·tan(elevation). Every solid but the ellipsoid is a
vertical prism, so its outline is met once for each column and only the height is asked once for each ray. The slope of
the ground shears all heights, which leaves verticals upright: here the ground is flat and the tangents bend instead.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int16

from lidargrit.sensors import SensorModel
from lidargrit.simulator.solids import Solid
from lidargrit.simulator.street import KERB_M, SENSOR_HEIGHT_M, Street

ROAD, PAVEMENT, SKY = -3, -2, -1  # what a ray can meet besides the solids, which count from 0


@dataclass(frozen=True, eq=False)
class Rays:
    """The directions to cast, in rows from the top and columns of falling azimuth."""

    elevation_rad: Float[np.ndarray, " H #W"]
    azimuth_rad: Float[np.ndarray, "#H W"]

    @classmethod
    def of_sensor(cls, sensor: SensorModel) -> Rays:
        """Return the rays of all the columns that a sensor fires, those its image leaves out included."""
        elevation, azimuth = sensor.elevation_rad, sensor.azimuth_rad
        if sensor.column_stride > 1:
            azimuth = sensor.with_columns(sensor.width * sensor.column_stride).azimuth_rad
            if elevation.shape[1] > 1:
                elevation = elevation.repeat_interleave(sensor.column_stride, dim=1)
        return cls(elevation.double().numpy(), azimuth.double().numpy())

    @classmethod
    def kept_by(cls, sensor: SensorModel) -> Rays:
        """Return the rays of only the columns that a sensor's image keeps."""
        return cls(sensor.elevation_rad.double().numpy(), sensor.azimuth_rad.double().numpy())


@dataclass(frozen=True, eq=False)
class Hits:
    """What every ray meets first.

    Args:
        way_m: horizontal distance to it, infinite for the sky.
        solid: index among the street's solids, or ROAD, PAVEMENT, SKY.
        cos_incidence: cosine between the ray and the normal of the surface, 0 for the sky.
    """

    way_m: Float32[np.ndarray, "H W"]
    solid: Int16[np.ndarray, "H W"]
    cos_incidence: Float32[np.ndarray, "H W"]


def cast(street: Street, rays: Rays, free_path: Float32[np.ndarray, "H W"]) -> Hits:
    """Find what every ray of a sensor meets first in a street.

    Args:
        street: what stands around the sensor.
        rays: where to look.
        free_path: how far a ray gets into leaves, in their mean free path; exponentially distributed.
    """
    cos, sin = np.cos(rays.azimuth_rad), np.sin(rays.azimuth_rad)  # (#H, W)
    tangent = (np.tan(rays.elevation_rad) - street.slope_x * cos - street.slope_y * sin).astype(np.float32)  # (H, W)
    flat = 1 / np.sqrt(1 + tangent**2)  # cosine of the elevation over the flat ground
    hits = _ground(street, cos, sin, tangent)
    azimuth_of_column = rays.azimuth_rad.mean(axis=0)
    spread = float(np.ptp(rays.azimuth_rad, axis=0).max())  # a column may lean from row to row
    for index, solid in enumerate(street.solids):
        for span in _columns_of(solid, azimuth_of_column, spread):
            local = cos[:, span], sin[:, span], tangent[:, span]
            way, cos_side = _meet(solid, *local, free_path[:, span])
            nearer = way < hits.way_m[:, span]
            np.copyto(hits.way_m[:, span], way, where=nearer)
            np.copyto(hits.solid[:, span], np.int16(index), where=nearer)
            np.copyto(hits.cos_incidence[:, span], cos_side * flat[:, span], where=nearer)
    return hits


def _ground(street: Street, cos: np.ndarray, sin: np.ndarray, tangent: np.ndarray) -> Hits:
    """Meet the road, the pavement that lies a kerb higher, or the sky."""
    way = np.float32(SENSOR_HEIGHT_M) / np.maximum(-tangent, np.float32(1e-4))  # the sky, set apart below, gets 17 km
    raised = way * ((SENSOR_HEIGHT_M - KERB_M) / SENSOR_HEIGHT_M)
    cos_yaw, sin_yaw = math.cos(street.yaw_rad), math.sin(street.yaw_rad)
    ahead = (cos * cos_yaw + sin * sin_yaw).astype(np.float32)
    left = (sin * cos_yaw - cos * sin_yaw).astype(np.float32)

    def beyond_kerb(at: np.ndarray) -> np.ndarray:
        offset = at * left - np.float32(street.curvature_per_m / 2) * (at * ahead) ** 2
        return np.abs(offset + np.float32(street.sensor_offset_m)) - np.float32(street.half_road_m)

    on_road, on_pavement = beyond_kerb(way), beyond_kerb(raised)
    at_kerb = (on_road > 0) & (on_pavement <= 0)  # past the edge low down, before it higher up: the face between
    share = np.where(at_kerb, on_pavement / np.where(at_kerb, on_pavement - on_road, 1), 0)
    kerb_way = raised + share * (way - raised)
    paved = (on_pavement > 0) | at_kerb
    solid = np.where(tangent < 0, np.where(paved, np.int16(PAVEMENT), np.int16(ROAD)), np.int16(SKY))
    cos_ground = -np.minimum(tangent, 0) / np.sqrt(1 + tangent**2)
    cos_kerb = np.abs(left) / np.sqrt(1 + tangent**2)
    way = np.where(tangent < 0, np.where(paved, kerb_way, way), np.float32(np.inf))
    return Hits(way, solid, np.where(at_kerb, cos_kerb, cos_ground))


def _columns_of(solid: Solid, azimuth_rad: np.ndarray, spread_rad: float) -> list[slice]:
    """Return the columns, one run or two, in which a solid may be seen; azimuths fall from near +pi to near -pi."""
    away = math.hypot(solid.x_m, solid.y_m)
    if solid.shape == "box":
        along, across = solid.half_length_m, solid.half_width_m
        radius = math.hypot(along, across)
    else:
        along = across = radius = solid.half_length_m
    if away <= radius:
        return [slice(0, len(azimuth_rad))]
    middle = math.atan2(solid.y_m, solid.x_m)
    if solid.shape == "box":
        cos, sin = math.cos(solid.yaw_rad), math.sin(solid.yaw_rad)
        turns = []
        for a, b in ((along, across), (along, -across), (-along, across), (-along, -across)):
            corner = math.atan2(solid.y_m + sin * a + cos * b, solid.x_m + cos * a - sin * b)
            turns.append(math.remainder(corner - middle, 2 * math.pi))
        low, high = middle + min(turns) - spread_rad, middle + max(turns) + spread_rad
    else:
        half = math.asin(radius / away) + spread_rad
        low, high = middle - half, middle + half
    spans = []
    for turn in (-2 * math.pi, 0.0, 2 * math.pi):
        first, last = np.searchsorted(-azimuth_rad, (-(high + turn), -(low + turn)))
        if first < last:
            spans.append(slice(int(first), int(last)))
    return spans


def _meet(
    solid: Solid, cos: np.ndarray, sin: np.ndarray, tangent: np.ndarray, free_path: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the way to a solid along each ray, infinite where it is missed, and the cosine on its outline."""
    low, high = solid.bottom_m - SENSOR_HEIGHT_M, solid.top_m - SENSOR_HEIGHT_M
    if solid.shape == "ellipsoid":
        enter, leave = _ellipsoid(solid, low, high, cos, sin, tangent)
        cos_side = np.ones_like(tangent)
    else:
        outline = _box if solid.shape == "box" else _circle
        enter, leave, cos_outline = (a.astype(np.float32) for a in outline(solid, cos, sin))
        with np.errstate(divide="ignore"):
            inverse = 1 / tangent
        to_low, to_high = low * inverse, high * inverse
        at_height, past_height = np.minimum(to_low, to_high), np.maximum(to_low, to_high)
        cos_side = np.where(at_height > enter, np.abs(tangent), cos_outline)  # from above: the normal points up
        enter, leave = np.maximum(enter, at_height), np.minimum(leave, past_height)
    if solid.free_path_m:
        enter = enter + free_path * np.float32(solid.free_path_m)
        cos_side = np.full_like(tangent, 0.6)  # leaves stand in all directions
    return np.where((enter < leave) & (enter > 0), enter, np.float32(np.inf)), cos_side


def _box(solid: Solid, cos: np.ndarray, sin: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Meet the rectangle by its two slabs."""
    cos_yaw, sin_yaw = math.cos(solid.yaw_rad), math.sin(solid.yaw_rad)
    along, across = cos * cos_yaw + sin * sin_yaw, sin * cos_yaw - cos * sin_yaw  # the ray in the box's frame
    centre_along = solid.x_m * cos_yaw + solid.y_m * sin_yaw
    centre_across = solid.y_m * cos_yaw - solid.x_m * sin_yaw
    with np.errstate(divide="ignore"):
        per_along, per_across = 1 / along, 1 / across
    middle_l, half_l = centre_along * per_along, solid.half_length_m * np.abs(per_along)
    middle_w, half_w = centre_across * per_across, solid.half_width_m * np.abs(per_across)
    end_first = middle_l - half_l > middle_w - half_w
    enter = np.maximum(middle_l - half_l, middle_w - half_w)
    leave = np.minimum(middle_l + half_l, middle_w + half_w)
    return enter, leave, np.where(end_first, np.abs(along), np.abs(across))


def _circle(solid: Solid, cos: np.ndarray, sin: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Meet the circle of a cylinder."""
    middle = solid.x_m * cos + solid.y_m * sin
    half_squared = solid.half_length_m**2 - (solid.x_m * sin - solid.y_m * cos) ** 2
    half = np.sqrt(np.maximum(half_squared, 0))
    leave = np.where(half_squared > 0, middle + half, -np.inf)
    return middle - half, leave, half / solid.half_length_m


def _ellipsoid(
    solid: Solid, low: float, high: float, cos: np.ndarray, sin: np.ndarray, tangent: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Meet an ellipsoid that is round in the plan: a quadratic equation in the horizontal way."""
    flat, tall = 1 / solid.half_length_m**2, 4 / (high - low) ** 2
    centre = (low + high) / 2
    towards = (solid.x_m * cos + solid.y_m * sin).astype(np.float32)
    a = np.float32(flat) + np.float32(tall) * tangent**2
    b = np.float32(flat) * towards + np.float32(tall * centre) * tangent
    c = np.float32(flat * (solid.x_m**2 + solid.y_m**2) + tall * centre**2 - 1)
    discriminant = b**2 - a * c
    half = np.sqrt(np.maximum(discriminant, 0))
    return (b - half) / a, np.where(discriminant > 0, (b + half) / a, np.float32(-np.inf))
