"""Scans without a car: a seed → a procedural street → the returns of a sensor in it."""

from __future__ import annotations

import numpy as np
import torch

from lidargrit.errors import ConfigError
from lidargrit.sensors import SensorModel, load_sensor
from lidargrit.simulator.raycast import Rays, cast
from lidargrit.simulator.returns import Chances, returns
from lidargrit.simulator.street import draw_street
from lidargrit.structures import Scan

__all__ = ["simulate"]


def simulate(seed: int, sensor: SensorModel | None = None, kept_columns_only: bool = False) -> Scan:
    """Simulate one revolution of a sensor in a street drawn from a seed.

    A beam is lost when its received power, which falls with range, with incidence and on dark, glossy or transparent
    surfaces, stays below a threshold. The power's random part is alike along a ring and over an object, so that drops
    come in patches as they do on the road.

    Args:
        seed: of the street and of the noise, not negative; the same seed gives the same scan, bit for bit.
        sensor: whose rays are cast, every column that it fires; the HDL-64E of KITTI odometry if not given.
        kept_columns_only: cast only the columns that the sensor's image keeps, at 1 / column_stride of the work. The
            points are those of the whole scan that fall into these columns.

    Returns:
        points in the firing order of KITTI's files: ring by ring from the top, each counter-clockwise from straight
        ahead; with ring and reflectance.

    Raises:
        ConfigError: a negative seed.

    Example:
        >>> scan = simulate(seed=0)
        >>> int(scan.ring.max())
        63
    """
    if seed < 0:
        raise ConfigError(f"the seed {seed}", "a seed of 0 or more", "choose another seed")
    sensor = sensor or load_sensor("hdl64e_kitti_odometry")
    street_rng, beam_rng = np.random.default_rng(seed).spawn(2)
    street = draw_street(street_rng)
    chances = Chances.draw(beam_rng, sensor.height, sensor.width * sensor.column_stride)
    rays = Rays.of_sensor(sensor)
    if kept_columns_only:
        chances, rays = chances.every(sensor.column_stride), Rays.kept_by(sensor)
    hits = cast(street, rays, chances.free_path)
    range_m, came_back, reflectance = returns(street, rays, hits, chances)
    came_back &= (range_m >= sensor.range_min_m) & (range_m <= sensor.range_max_m)
    return _in_firing_order(rays, range_m, came_back, reflectance, source=f"simulated scan {seed}")


def _in_firing_order(
    rays: Rays, range_m: np.ndarray, came_back: np.ndarray, reflectance: np.ndarray, source: str
) -> Scan:
    azimuth = np.broadcast_to(rays.azimuth_rad, range_m.shape)
    elevation = np.broadcast_to(rays.elevation_rad, range_m.shape)
    firing = np.argsort(rays.azimuth_rad % (2 * np.pi), axis=1)  # (#H, W)
    column = np.broadcast_to(firing, range_m.shape)
    ring, place = np.nonzero(np.take_along_axis(came_back, column, axis=1))
    column = column[ring, place]
    measured, az, el = range_m[ring, column].astype(np.float64), azimuth[ring, column], elevation[ring, column]
    flat = measured * np.cos(el)
    xyz_m = np.stack((flat * np.cos(az), flat * np.sin(az), measured * np.sin(el)), axis=1).astype(np.float32)
    return Scan(
        torch.from_numpy(xyz_m),
        torch.from_numpy(reflectance[ring, column]),
        torch.from_numpy(ring),
        source=source,
    )
