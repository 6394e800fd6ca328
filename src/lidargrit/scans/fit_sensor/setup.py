"""Scans and the rays of their sensor → the set-up of the unit that made them, as far as planes tell it."""

from collections.abc import Sequence

import numpy as np

from lidargrit.core.determinism import evenly_spaced
from lidargrit.scans.projection import project
from lidargrit.scans.sensors import SensorModel, SensorSetup
from lidargrit.scans.surface_patches import height_above_ground, range_noise, row_offsets, row_readings
from lidargrit.scans.types import RangeImage, Scan

_SCANS_AT_MOST = 8  # a tenth of a second each for every fit of planes
_OFFSET_M = 0.5  # beyond it is no laser's error
_READING = (0.1, 10.0)
_KITTIS_MEDIAN = 0.31  # reflectance of KITTI odometry 00, whose scale is 1
_SCALE = (0.01, 10.0)


def fit_setup(scans: Sequence[Scan], sensor: SensorModel) -> SensorSetup | None:
    """Return noise, offsets and readings of lasers, height and scale of reflectance; None if scans show few planes.

    What the scans do not tell is as in :class:`.SensorSetup`: gains in power, width and splitting of beams, glass,
    firings that are missing.

    Args:
        scans: scans of one unit in its own frame.
        sensor: rays of the sensor, with every column that it fires.
    """
    images = [project(scans[index], sensor) for index in evenly_spaced(_SCANS_AT_MOST, len(scans))]
    noise = range_noise(images)
    if noise is None:
        return None
    height_m = height_above_ground(images)
    reading = row_readings(images)
    return SensorSetup(
        range_sigma_m=round(min(noise[0], 0.5), 4),
        range_sigma_per_m=round(min(noise[1], 0.05), 5),
        offset_m=tuple(row_offsets(images).clip(-_OFFSET_M, _OFFSET_M).round(4).tolist()),
        reading=() if reading is None else tuple(reading.clip(*_READING).round(3).tolist()),
        reflectance_scale=_scale(images),
        height_m=SensorSetup.height_m if height_m is None else round(height_m, 2),
    )


def _scale(images: Sequence[RangeImage]) -> float:
    """Return the median reflectance over that of KITTI; 1 if there is none."""
    read = [image.reflectance[image.return_mask].numpy() for image in images if image.reflectance is not None]
    median = float(np.median(np.concatenate(read))) if read else 0.0
    return round(float(np.clip(median / _KITTIS_MEDIAN, *_SCALE)), 3) if median > 0 else 1.0
