"""Who wins a pixel: scan → range image, by spherical projection or by scan unfolding."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from jaxtyping import Float32, Int32

from lidargrit import _discovery
from lidargrit.errors import ScanError
from lidargrit.projection import spherical, unfolding
from lidargrit.sensors import ProjectionName, SensorModel, load_sensor
from lidargrit.structures import RangeImage, Scan

Variant = Literal["exact", "reference"]

_OUTSIDE_AT_MOST = 0.25  # KITTI leaves up to 8 % of its points above +3 degrees; a wrong sensor leaves far more
_SECTORS = 36  # of 10 degrees: the coarsest sensor has several columns in each
_SECTORS_AT_LEAST = 27  # with a return: KITTI's scans have all, a crop to the camera's view a quarter


def project(
    scan: Scan, sensor: SensorModel, method: ProjectionName | None = None, variant: Variant = "exact"
) -> RangeImage:
    """Place each point of a scan in the pixel whose ray it lies on; the nearest point wins a pixel.

    Column w spans azimuths [pi - 2 pi w/W, pi - 2 pi (w+1)/W): pixel centres sit at w + 1/2, so that the first and
    last columns are as wide as the others. With a column stride, the columns between the kept ones are left out.

    Args:
        scan: points in the sensor's frame; in firing order, or with their ring, for ``unfolding``.
        sensor: the rays of the image and the limits of range.
        method: ``spherical`` (rows by elevation) or ``unfolding`` (rows by ring); the sensor's own if not given.
        variant: ``exact`` floors, leaves out points beyond the sensor's span or limits before the nearest one wins, and
            refuses a scan that does not fit. ``reference`` repeats LidarGRIT's program: it rounds, clips points outside
            into the border pixels, and loses a pixel whose nearest point is beyond the limits.

    Returns:
        range_m (H, W) in metres and return_mask (H, W), with the reflectance if the scan has it.

    Raises:
        ScanError: the scan does not fit the sensor; names the sensors that would.

    Source:
        Haghighi et al., LidarGRIT, 2024, section 3.1; program hamedhaghighi/LidarGRIT@a3f86e7.
    """
    point_of_pixel = index_map(scan, sensor, method, variant)[:, :: sensor.column_stride]
    filled = point_of_pixel >= 0
    if not filled.any():
        raise ScanError(
            f"no point between {sensor.range_min_m:g} and {sensor.range_max_m:g} m in {scan.source}",
            "returns within the sensor's range limits",
            "check that the file is in metres, or choose another sensor",
        )
    range_of_point = np.linalg.norm(scan.points_xyz_m.numpy(), axis=1)
    range_m = np.where(filled, range_of_point[point_of_pixel], np.float32(0))
    if variant == "reference":  # there the limits are applied to the winner, and strictly
        filled &= (range_m > sensor.range_min_m) & (range_m < sensor.range_max_m)
        range_m = np.where(filled, range_m, np.float32(0))
    reflectance = None
    if scan.reflectance is not None:
        reflectance = torch.from_numpy(np.where(filled, scan.reflectance.numpy()[point_of_pixel], np.float32(0)))
    return RangeImage(torch.from_numpy(range_m), torch.from_numpy(filled), sensor, reflectance)


def index_map(
    scan: Scan, sensor: SensorModel, method: ProjectionName | None = None, variant: Variant = "exact"
) -> Int32[np.ndarray, "H fine_W"]:
    """Return which point fills each pixel before any column is left out: its index in the scan, -1 for none.

    Args, Raises: as for :func:`project`.
    """
    xyz_m = scan.points_xyz_m.numpy()
    method = method or sensor.projection
    height, width = sensor.height, sensor.width * sensor.column_stride
    range_m = np.linalg.norm(xyz_m, axis=1)
    if variant == "reference":
        row = (
            spherical.reference_rows(xyz_m, height)
            if method == "spherical"
            else unfolding.reference_rings(xyz_m, height)
        )
        column, eligible = unfolding.reference_columns(xyz_m, width), np.ones(len(xyz_m), dtype=bool)
    else:
        _check_full_circle(scan, xyz_m)
        row = _exact_spherical_rows(scan, sensor) if method == "spherical" else _exact_unfolding_rows(scan, sensor)
        column = unfolding.columns(xyz_m, width)
        eligible = (row >= 0) & (range_m >= sensor.range_min_m) & (range_m <= sensor.range_max_m)
    far_to_near = np.argsort(-range_m, kind="stable")
    far_to_near = far_to_near[eligible[far_to_near]]
    winner = np.full((height, width), -1, dtype=np.int32)
    winner[row[far_to_near], column[far_to_near]] = (
        far_to_near  # of several points the last written, the nearest, stays
    )
    return winner


def _exact_spherical_rows(scan: Scan, sensor: SensorModel) -> np.ndarray:
    xyz_m = scan.points_xyz_m.numpy()
    row = spherical.rows(xyz_m, _row_elevation_rad(sensor))
    outside = float((row < 0).mean())
    if outside > _OUTSIDE_AT_MOST:
        low, high = np.degrees(_elevation_span_rad(xyz_m))
        top, bottom = np.degrees(spherical.row_edges_rad(_row_elevation_rad(sensor))[[0, -1]])
        raise ScanError(
            f"{outside:.0%} of the points of {scan.source} outside the sensor's elevations (the scan spans "
            f"{low:.1f} to {high:.1f} degrees)",
            f"{bottom:.1f} to {top:.1f} degrees for {sensor.name!r}",
            f"choose the sensor that made the scan: {_sensors_that_fit(low, high)}",
        )
    return row


def _exact_unfolding_rows(scan: Scan, sensor: SensorModel) -> np.ndarray:
    if scan.ring is not None:
        ring = scan.ring.numpy().astype(np.int64)
        fits = int(ring.min()) >= 0 and int(ring.max()) < sensor.height  # a ring without any return is no fault
    else:
        ring = unfolding.rings_from_firing_order(scan.points_xyz_m.numpy())
        fits = int(ring.max()) + 1 == sensor.height
    if not fits:
        rings = int(ring.max()) + 1
        raise ScanError(
            f"{rings} rings in {scan.source}",
            f"the {sensor.height} rings of the sensor {sensor.name!r}, in firing order",
            "remove the file if the sweep was cut, or project by elevation with --set data.projection=spherical",
        )
    return ring


def _check_full_circle(scan: Scan, xyz_m: Float32[np.ndarray, "n 3"]) -> None:
    sectors = len(np.unique(np.floor(unfolding.azimuths_rad(xyz_m) * (_SECTORS / (2 * np.pi)))))
    if len(xyz_m) > _SECTORS and sectors < _SECTORS_AT_LEAST:
        raise ScanError(
            f"returns in only {sectors * 360 // _SECTORS} of 360 degrees of azimuth in {scan.source}",
            "a full revolution",
            "use the uncropped scan",
        )


def _row_elevation_rad(sensor: SensorModel) -> np.ndarray:
    return sensor.elevation_rad.mean(dim=1).double().numpy()


def _elevation_span_rad(xyz_m: np.ndarray) -> np.ndarray:
    return np.quantile(np.arctan2(xyz_m[:, 2], np.hypot(xyz_m[:, 0], xyz_m[:, 1])), (0.01, 0.99))


def _sensors_that_fit(low_deg: float, high_deg: float) -> str:
    fitting = []
    for name in _discovery.names("sensors"):
        edges = np.degrees(spherical.row_edges_rad(_row_elevation_rad(load_sensor(name))))
        if edges[-1] - 1 <= low_deg and high_deg <= edges[0] + 1:
            fitting.append(name)
    return " or ".join(fitting) if fitting else "none of ours does; describe it in a sensor file"
