"""Does a scan fit a sensor? Scan, sensor → the problems, and the bundled sensors that would fit."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from torch import Tensor

from lidargrit import _discovery
from lidargrit.errors import ScanError
from lidargrit.projection import spherical, unfolding
from lidargrit.projection.pixel_coordinates import PixelCoordinates, row_elevation_rad
from lidargrit.sensors import ProjectionName, SensorModel, load_sensor
from lidargrit.structures import Scan

_OUTSIDE_AT_MOST = 0.25  # KITTI leaves up to 8 % of its points above +3 degrees; a wrong sensor leaves far more
_SECTORS = 36  # of 10 degrees: the coarsest sensor has several columns in each
_SECTORS_AT_LEAST = 27  # with a return: KITTI's scans have all, a crop to the camera's view a quarter


def fit_problems(
    scan: Scan, sensor: SensorModel, method: ProjectionName, pixels: PixelCoordinates, partial: bool = False
) -> Iterator[ScanError]:
    """Yield each problem that would make an exact projection of the scan wrong; none for a scan that fits."""
    for check in (None if partial else _part_of_a_circle(scan), _wrong_rows(scan, sensor, method, pixels)):
        if check is not None:
            yield check


def sensors_that_fit(scan: Scan) -> list[str]:
    """Name the bundled sensors whose rows span the elevations of a scan; the tightest comes first."""
    low_deg, high_deg = elevation_span_deg(scan)
    spans_deg = {name: _span_of_rows_deg(load_sensor(name)) for name in _discovery.names("sensors")}
    fitting = {
        name: top - bottom for name, (bottom, top) in spans_deg.items() if bottom - 1 <= low_deg and high_deg <= top + 1
    }
    return sorted(fitting, key=lambda name: fitting[name])


def closest_sensor(scan: Scan) -> str:
    """Guess the bundled sensor: as many rows as the scan has rings, then the most similar span of elevations.

    If the scan neither names its rings nor is stored ring by ring, or no sensor has as many rows, the elevations alone
    decide.
    """
    low_deg, high_deg = elevation_span_deg(scan)
    rings = ring_count(scan)

    def distance(name: str) -> tuple[bool, float]:
        sensor = load_sensor(name)
        bottom_deg, top_deg = _span_of_rows_deg(sensor)
        return sensor.height != rings, abs(bottom_deg - low_deg) + abs(top_deg - high_deg)

    return min(_discovery.names("sensors"), key=distance)


def ring_count(scan: Scan) -> int:
    """Count the rings of a scan by its highest ring index, or by its firing order if it names no rings."""
    if scan.ring is not None:
        return int(scan.ring.max()) + 1
    return int(unfolding.rings_from_firing_order(scan.points_xyz_m.numpy().T)[-1]) + 1


def elevation_span_deg(scan: Scan) -> tuple[float, float]:
    """Return the 1 % and the 99 % quantile of the elevations of the points, in degrees."""
    low, high = np.quantile(elevations_deg(scan.points_xyz_m), (0.01, 0.99))
    return float(low), float(high)


def elevations_deg(points_xyz_m: Tensor) -> np.ndarray:
    """Return the elevation of points (n, 3) in degrees, (n,)."""
    x, y, z = points_xyz_m.numpy().T
    return np.degrees(np.arctan2(z, np.hypot(x, y)))


def _part_of_a_circle(scan: Scan) -> ScanError | None:
    if len(scan) <= _SECTORS:
        return None
    sectors = 0
    for step in (64, 1):  # sectors that some points show, all points show as well
        azimuth_rad = unfolding.azimuths_rad(scan.points_xyz_m[::step].numpy().T)
        sectors = len(np.unique(np.floor(azimuth_rad * (_SECTORS / (2 * np.pi)))))
        if sectors >= _SECTORS_AT_LEAST:
            return None
    return ScanError(
        f"returns in only {sectors * 360 // _SECTORS} of 360 degrees of azimuth in {scan.source}",
        "a full revolution",
        "use the uncropped scan",
    )


def _wrong_rows(scan: Scan, sensor: SensorModel, method: ProjectionName, pixels: PixelCoordinates) -> ScanError | None:
    if method == "spherical":
        outside = 1 - np.count_nonzero(pixels.in_rows()) / len(scan)
        return _wrong_elevations(scan, sensor, outside) if outside > _OUTSIDE_AT_MOST else None
    rings = int(pixels.row.max()) + 1
    if scan.ring is None and rings == sensor.height:
        return None
    if scan.ring is not None and int(pixels.row.min()) >= 0 and rings <= sensor.height:  # a ring may lack any return
        return None
    return ScanError(
        f"{rings} rings in {scan.source}",
        f"the {sensor.height} rings of the sensor {sensor.name!r}, in firing order",
        "remove the file if the sweep was cut, or project by elevation with --set data.projection=spherical",
    )


def _wrong_elevations(scan: Scan, sensor: SensorModel, outside: float) -> ScanError:
    low_deg, high_deg = elevation_span_deg(scan)
    bottom_deg, top_deg = _span_of_rows_deg(sensor)
    fitting = " or ".join(sensors_that_fit(scan)) or "none of ours does; describe it in a sensor file"
    return ScanError(
        f"{outside:.0%} of the points of {scan.source} outside the sensor's elevations (the scan spans "
        f"{low_deg:.1f} to {high_deg:.1f} degrees)",
        f"{bottom_deg:.1f} to {top_deg:.1f} degrees for {sensor.name!r}",
        f"choose the sensor that made the scan: {fitting}",
    )


def _span_of_rows_deg(sensor: SensorModel) -> tuple[float, float]:
    edges_deg = np.degrees(spherical.row_edges_rad(row_elevation_rad(sensor)))
    return float(edges_deg[-1]), float(edges_deg[0])
