"""Sensors drawn at random, to train one model for all: a seed → rays, limits and set-up of a sensor."""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float64

from lidargrit.scans.sensors import SensorModel, SensorSetup, column_azimuths_rad, load_sensor

_KNOWN = (
    "hdl32e",
    "hdl32e_nuscenes",
    "hdl64e_kitti_360",
    "hdl64e_kitti_odometry",
    "os1_64",
    "os1_128",
    "pandar64",
    "vlp16",
    "vlp32c",
)
_SHIFT_DEG = 0.3
_ROWS = (16, 32, 40, 64, 128)
_STRIDES = {1024: (1, 2, 4), 1536: (1, 2, 4), 1800: (1, 3, 5), 2048: (1, 2, 4, 8)}  # by fine columns
_PIXELS_AT_MOST = 1 << 15  # so that a batch of any sensor takes about as long
_LOWEST_DEG = -35.0


def drawn_sensor(seed: int) -> SensorModel:
    """Return the sensor ``drawn_SEED``: one that nobody sells, or half of the time a known one whose rows are shifted.

    The first have 16 to 128 rows over 10 to 45 degrees, even, dense in the middle or in two blocks, limits of 50 to
    240 m, and a set-up of their own: 1.2 to 2.5 m above the road, noise of 5 to 40 mm, gains and jitter. Shifted ones
    have no set-up that is known. All have 256 to 2,048 columns, of which images hold at most 32,768 pixels.

    Args:
        seed: seed, 0 or more; the same one gives the same sensor.
    """
    rng = np.random.default_rng((seed, 0x5E45))
    if rng.random() < 0.5:
        known = load_sensor(str(rng.choice(_KNOWN)))
        shift_rad = math.radians(float(rng.uniform(-_SHIFT_DEG, _SHIFT_DEG)))
        sensor = replace(known, name=f"drawn_{seed}", elevation_rad=known.elevation_rad + shift_rad)
    else:
        sensor = _new(seed, rng)
    sizes = [
        (fine, stride)
        for fine, strides in _STRIDES.items()
        for stride in strides
        if sensor.height * fine // stride <= _PIXELS_AT_MOST
    ]
    return sensor.with_columns(*sizes[int(rng.integers(len(sizes)))])


def _new(seed: int, rng: np.random.Generator) -> SensorModel:
    rows = int(rng.choice(_ROWS)) - int(rng.integers(4)) * int(rng.random() < 0.25)
    elevation_rad = np.radians(_elevations_deg(rows, rng))
    setup = replace(
        SensorSetup.sample(rng, rows),
        range_sigma_m=float(np.exp(rng.uniform(math.log(0.005), math.log(0.04)))),
        height_m=float(rng.uniform(1.2, 2.5)),
    )
    return SensorModel(
        name=f"drawn_{seed}",
        elevation_rad=torch.from_numpy(elevation_rad).float()[:, None],
        azimuth_rad=column_azimuths_rad(max(_STRIDES)),
        range_min_m=float(rng.uniform(0.3, 2.0)),
        range_max_m=float(np.exp(rng.uniform(math.log(50), math.log(240)))),
        projection="spherical",
        source="drawn at random",
        setup=setup,
    )


def _elevations_deg(rows: int, rng: np.random.Generator) -> Float64[np.ndarray, " rows"]:
    """Return elevations that fall from row to row: even, dense in the middle, or in two blocks."""
    field = float(rng.uniform(max(10.0, 0.15 * rows), 45))
    top = float(rng.uniform(max(2.0, field + _LOWEST_DEG), min(25.0, 0.7 * field)))
    steps, kind = np.ones(rows - 1), int(rng.integers(3))
    if kind == 1:
        even = float(rng.uniform(0.15, 0.5))
        steps = even + 3 * (1 - even) * np.linspace(-1, 1, rows - 1) ** 2
    elif kind == 2:
        steps[int(rows * rng.uniform(0.3, 0.7)) :] *= float(rng.uniform(1.2, 2.5))
    return top - field * np.concatenate(([0.0], steps.cumsum() / steps.sum()))
