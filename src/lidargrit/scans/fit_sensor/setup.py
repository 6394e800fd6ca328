"""Scans and the rays of their sensor → the set-up of the unit that made them, as far as planes tell it."""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np
from jaxtyping import Float64

from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import ScanError
from lidargrit.scans.projection import project_by_what_fits
from lidargrit.scans.sensors import SensorModel, SensorSetup
from lidargrit.scans.surface_patches import range_noise, row_offsets, row_readings
from lidargrit.scans.types import RangeImage, Scan

_SCANS_AT_MOST = 8  # a tenth of a second each for every fit of planes
_GROUND_M, _BELOW_M, _NEAR_PLANE_M = 15.0, 0.8, 0.05  # reach of the ground that counts, and how it is weighed
_ON_GROUND, _POINTS = 0.3, 500  # share of the points below the sensor, and their number, that make a ground
_OFFSET_M = 0.5  # beyond it is no laser's error
_READING = (0.1, 10.0)
_KITTIS_MEDIAN = 0.31  # reflectance of KITTI odometry 00, whose scale is 1
_SCALE = (0.01, 10.0)


def fit_setup(scans: Sequence[Scan], sensor: SensorModel) -> tuple[SensorSetup | None, tuple[str, ...]]:
    """Return noise, offsets and readings of lasers, height and scale of reflectance; None if scans show few planes.

    Besides, it returns a note on what had to be assumed.

    What the scans do not tell is as in :class:`.SensorSetup`: gains in power, width and splitting of beams, glass,
    firings that are missing.

    Args:
        scans: scans of one unit in its own frame.
        sensor: rays of the sensor, with every column that it fires.
    """
    chosen = evenly_spaced(_SCANS_AT_MOST, len(scans))
    images = []
    for index in chosen:
        with suppress(ScanError):  # a scan that lacks rings still told the rows of others
            images.append(project_by_what_fits(scans[index], sensor, partial=True)[0])
    noise = range_noise(images) if images else None
    if noise is None:
        return None, ()
    height_m = _height_m([scans[index] for index in chosen])
    reading = row_readings(images)
    setup = SensorSetup(
        range_sigma_m=round(min(noise[0], 0.5), 4),
        range_sigma_per_m=round(min(noise[1], 0.05), 5),
        offset_m=tuple(row_offsets(images).clip(-_OFFSET_M, _OFFSET_M).round(4).tolist()),
        reading=() if reading is None else tuple(reading.clip(*_READING).round(3).tolist()),
        reflectance_scale=_scale(images),
        height_m=SensorSetup.height_m if height_m is None else round(height_m, 2),
    )
    assumed = f"too little ground is seen to tell the sensor's height; simulated scans take {setup.height_m:g} m"
    return setup, (assumed,) if height_m is None else ()


def _scale(images: Sequence[RangeImage]) -> float:
    """Return the median reflectance over that of KITTI; 1 if there is none."""
    read = [image.reflectance[image.return_mask].numpy() for image in images if image.reflectance is not None]
    median = float(np.median(np.concatenate(read))) if read else 0.0
    return round(float(np.clip(median / _KITTIS_MEDIAN, *_SCALE)), 3) if median > 0 else 1.0


def _height_m(scans: Sequence[Scan]) -> float | None:
    """Return the median distance of the ground's plane from the sensor, in metres; None if no scan shows one.

    The plane is fitted to the points below the sensor by least squares, reweighted by 1 / (1 + (error / 5 cm)^2), so
    that walls and cars do not count. Pixels would not do: lasers that sit beside the origin see near ground from there.
    """
    found = [height for scan in scans if (height := _height_of(scan.points_xyz_m.double().numpy())) is not None]
    return float(np.median(found)) if found else None


def _height_of(points_xyz_m: Float64[np.ndarray, "n 3"]) -> float | None:
    below = points_xyz_m[(np.hypot(*points_xyz_m[:, :2].T) < _GROUND_M) & (points_xyz_m[:, 2] < -_BELOW_M)]
    if len(below) < _POINTS:
        return None
    terms, z_m = np.column_stack((below[:, :2], np.ones(len(below)))), below[:, 2]
    plane = np.array([0, 0, np.median(z_m)])
    for _ in range(8):
        root = np.sqrt(1 / (1 + ((z_m - terms @ plane) / _NEAR_PLANE_M) ** 2))
        plane = np.linalg.lstsq(terms * root[:, None], z_m * root)[0]
    if (np.abs(z_m - terms @ plane) < 2 * _NEAR_PLANE_M).mean() < _ON_GROUND:
        return None
    return float(-plane[2] / np.sqrt(1 + plane[0] ** 2 + plane[1] ** 2))
