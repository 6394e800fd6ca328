"""Whether a scan fits a sensor: scan, sensor → problems, the projection that fits, and the sensors that would fit."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Int
from torch import Tensor

from lidargrit.core import discovery
from lidargrit.core.errors import ScanError
from lidargrit.scans.projection import spherical, unfolding
from lidargrit.scans.projection.frame import MOST_ON_ROWS, Heights, other_frame, told_height
from lidargrit.scans.projection.pixel_coordinates import (
    PixelCoordinates,
    ProjectionVariant,
    pixel_coordinates,
    row_elevation_rad,
    within_limits,
)
from lidargrit.scans.projection.revolutions import told_revolutions
from lidargrit.scans.sensors import ProjectionName, SensorModel, load_sensor
from lidargrit.scans.types import Scan

_OUTSIDE_AT_MOST = 0.25  # KITTI leaves up to 8 % of its points above +3 degrees; a wrong sensor leaves far more
_SECTORS = 36  # of 10 degrees: the coarsest sensor has several columns in each
_SECTORS_AT_LEAST = 27  # with a return: KITTI's scans have all, a crop to the camera's view a quarter

# How far points lie from the elevation of the row that they are put into, in the median, as a share of all rows' span.
# Real scans in their own sensor's rows: up to 0.02; images without elevations (Karlsruhe): 0.08; rows by a firing
# order that is none, or upside down, or by rings of another sensor: 0.24 and more.
_MISPLACED_AT_MOST = 0.125
_POINTS_FOR_ORDER = 100  # fewer do not show an order
_POINTS_MEASURED, _POINTS_FOR_HEIGHT = 8192, 512
# Share of the elevations' variance: 0.01 in files stored ring by ring, 0.9 in shuffled ones.
_WITHIN_RINGS_AT_MOST = 0.1
_TWO_RINGS = 0.4  # of a row's height, between two points of one pixel: they are of two lasers
# Real scans in their own sensor's rows: up to 0.07 of the pixels, 0.17 in the 64 equal rows of KITTI-360's literature;
# scans of 64 or 128 lasers in half as many rows: 0.5 and more.
_CROWDED_AT_MOST = 0.35
_EMPTY_ROWS_AT_MOST = 0.4  # 0 to 0.1 in the rows of the scan's own sensor; scans of 16 lasers in 64 rows: 0.6 and more
# Pixels without points that have some within three columns on either side: up to 0.09 in the columns of the scan's own
# sensor; scans of 1,800 columns in 2,048: 0.18 to 0.28; of half as many: 0.5.
_EMPTY_BETWEEN_AT_MOST, _COLUMNS_AROUND = 0.2, 3
_RINGS_OFF_AT_MOST_DEG = 2.0  # of a sensor that may be the scan's: in the mean over its rows
_FEW_POINTS = 0.02  # of what a row has in the median: a stray point does not fill a row

_BY_ELEVATION = "project by elevation: --projection spherical (in Python: method='spherical' of project)"
_NAME_IT = "name the sensor that made the scan with --sensor"
FIT_SENSOR = "or find yours with lidargrit fit-sensor, and name its file in place of a sensor"


def fit_problems(
    scan: Scan,
    sensor: SensorModel,
    method: ProjectionName,
    pixels: PixelCoordinates,
    partial: bool = False,
    variant: ProjectionVariant = "exact",
) -> Iterator[ScanError]:
    """Yield each problem that makes the image of the scan wrong; none for a scan that fits.

    Programs take every scan. In their variants only that is a problem which puts most points into rows where the sensor
    does not look.
    """
    rows = _misplaced(scan, sensor, method, pixels, variant)
    if variant == "exact":
        rows = _wrong_rows(scan, sensor, method, pixels) or rows
    frame = other_frame(scan) if variant == "exact" else None
    yield from [frame] if frame else []
    for check in (None if partial or frame or variant != "exact" else _part_of_a_circle(scan), rows):
        if check is not None:
            yield check


def projection_that_fits(scan: Scan, sensor: SensorModel) -> ProjectionName:
    """Return the sensor's own projection, or ``spherical`` where that needs a firing order and the scan has none.

    Points have none where they name no ring and are stored neither ring by ring nor from the highest ring down:
    generated, simulated and shuffled clouds. A file whose rings are in order but too many or too few keeps the sensor's
    projection, which refuses it: it was cut, or is of another sensor.
    """
    scan = scan.measured()  # others were added in another order
    if sensor.projection == "spherical" or scan.ring is not None or len(scan) < _POINTS_FOR_ORDER:
        return sensor.projection
    ring = _rings_in_order(scan)
    if ring is None:
        return "spherical"
    other_count = int(ring[-1]) + 1 != sensor.height
    return sensor.projection if other_count or not _is_misplaced(scan, sensor, ring) else "spherical"


def has_few_rings(scan: Scan, sensor: SensorModel) -> bool:
    """Return whether a scan has at most half the rings of a sensor, but spread over its elevations.

    The upper rings alone, of points in firing order, are a file that was cut off.
    """
    scan = scan.measured()
    if not 1 < ring_count(scan) <= sensor.height // 2:
        return False
    if scan.ring is not None:
        return True
    bottom_deg, top_deg = _span_of_rows_deg(sensor)
    low_deg, _ = elevation_span_deg(scan)
    return _rings_in_order(scan) is not None and low_deg < bottom_deg + (top_deg - bottom_deg) / 4


def doubts_about_rays(scan: Scan, sensor: SensorModel, method: ProjectionName) -> str:
    """Return signs that another sensor than the named one made a scan, in a few words; "" if there are none.

    The image of such a scan is not wrong, point by point, but its rows are not those of the lasers.
    """
    if scan.filled is not None:  # a model's rays lie between those of the sensor
        return ""
    pixels = pixel_coordinates(scan, sensor, method, "exact")
    kept = np.flatnonzero(pixels.in_rows() & within_limits(pixels.range_m, sensor))
    if len(kept) < _POINTS_FOR_ORDER:
        return ""
    row = pixels.row[kept].astype(np.int64)
    count = np.bincount(row, minlength=sensor.height)
    used = np.flatnonzero(count > _FEW_POINTS * np.median(count[count > 0]))
    # The upper rows may all look at the sky; the lowest see the ground, if rows go by ring.
    last = sensor.height - 1 if method == "unfolding" else used[-1]
    empty = 1 - len(used) / (last - used[0] + 1)
    if empty > _EMPTY_ROWS_AT_MOST:
        return f"{empty:.0%} of its rows get no points: the sensor that made the scans has fewer lasers"
    has_points = np.zeros((sensor.height, pixels.width), dtype=bool)
    has_points[row, pixels.column[kept].astype(np.int64)] = True
    between = _empty_between(has_points[used])
    if between > _EMPTY_BETWEEN_AT_MOST:
        return f"{between:.0%} of the pixels between points are empty: the scans have fewer columns, or rows elsewhere"
    elevation_deg = elevations_deg(scan.points_xyz_m[kept])
    pixel = row * pixels.width + pixels.column[kept]
    order = np.lexsort((elevation_deg, pixel))
    first = np.flatnonzero(np.diff(pixel[order], prepend=-1))
    last = np.append(first[1:], len(order)) - 1
    height_deg = -np.diff(np.degrees(spherical.row_edges_rad(row_elevation_rad(sensor))))[row[order[first]]]
    apart_deg = elevation_deg[order[last]] - elevation_deg[order[first]]
    crowded = float((apart_deg > _TWO_RINGS * height_deg).mean())
    if crowded > _CROWDED_AT_MOST:
        return f"{crowded:.0%} of its pixels get points of two lasers: the sensor that made the scans has more of them"
    return ""


def _empty_between(has_points: Bool[np.ndarray, "H W"]) -> float:
    """Return the share of pixels without points among those that have some within a few columns on either side."""
    before, behind = np.zeros_like(has_points), np.zeros_like(has_points)
    for step in range(1, _COLUMNS_AROUND + 1):
        before |= np.roll(has_points, step, axis=1)
        behind |= np.roll(has_points, -step, axis=1)
    empty = ~has_points & before & behind
    return float(empty.sum() / max(1, (empty | has_points).sum()))


def told_doubts(scan: Scan, sensor: SensorModel, method: ProjectionName, source: str = "") -> tuple[str, str]:
    """Return what a person reads of signs that another sensor, or one elsewhere, made a scan, and of its revolutions.

    Args:
        source: name of the scan's source; its own if not given.

    Returns:
        a sentence each, "" where there is no such sign.
    """
    if not (doubt := told_height(scan, sensor)) and (about := doubts_about_rays(scan, sensor, method)):
        cure = f"{_NAME_IT}, or take a model of it, {FIT_SENSOR}"
        doubt = f"{source or scan.source}, imaged as {sensor.name}: {about}; {cure}"
    return doubt, told_revolutions(scan)


def sensors_that_fit(scan: Scan) -> list[str]:
    """Name the bundled sensors that may have made a scan, the likeliest first.

    Where rings are known these have as many rows, and the rows nearest to the rings come first. Else their rows span
    the elevations of the scan, and the tightest comes first.
    """
    sensors = {name: load_sensor(name) for name in discovery.names("sensors")}
    if (off_deg := _distances_of_rows_deg(scan, sensors)) is not None:
        near = [name for name, off in off_deg.items() if off < _RINGS_OFF_AT_MOST_DEG]
        return sorted(near, key=lambda name: off_deg[name])
    low_deg, high_deg = elevation_span_deg(scan)
    spans_deg = {name: _span_of_rows_deg(sensor) for name, sensor in sensors.items()}
    fitting = {
        name: top - bottom for name, (bottom, top) in spans_deg.items() if bottom - 1 <= low_deg and high_deg <= top + 1
    }
    return sorted(fitting, key=lambda name: fitting[name])


def closest_sensor(scan: Scan) -> str:
    """Guess the bundled sensor: that whose rows are nearest to the scan's rings, of those with as many rows.

    If the scan neither names its rings nor is stored ring by ring, or no sensor has as many rows, the most similar span
    of elevations decides; where its points do not lie on that sensor's rows, but on those of one that stands higher or
    lower, it is that one.
    """
    sensors = {name: load_sensor(name) for name in discovery.names("sensors")}
    if off_deg := _distances_of_rows_deg(scan, sensors):
        return min(off_deg, key=lambda name: off_deg[name])
    low_deg, high_deg = elevation_span_deg(scan)

    def distance_deg(name: str) -> float:
        bottom_deg, top_deg = _span_of_rows_deg(sensors[name])
        return abs(bottom_deg - low_deg) + abs(top_deg - high_deg)

    nearest = min(sensors, key=distance_deg)
    if Heights(scan, sensors[nearest], _POINTS_FOR_HEIGHT).are_own():
        return nearest
    moved = {name: Heights(scan, sensor, _POINTS_FOR_HEIGHT).best()[0] for name, sensor in sensors.items()}
    name = max(moved, key=moved.__getitem__)
    return name if moved[name] >= MOST_ON_ROWS else nearest


def _distances_of_rows_deg(scan: Scan, sensors: dict[str, SensorModel]) -> dict[str, float] | None:
    """Return how far rings lie from the rows of each sensor with as many, in the mean; None where rings are unknown."""
    scan = scan.measured()
    ring = known_rings(scan)
    if ring is None or int(ring.min()) < 0:
        return None
    points = np.bincount(ring)
    there = np.flatnonzero(points)
    mean_deg = np.bincount(ring, elevations_deg(scan.points_xyz_m))[there] / points[there]
    return {
        name: float(np.abs(mean_deg - np.degrees(row_elevation_rad(sensor))[there]).mean())
        for name, sensor in sensors.items()
        if sensor.height == len(points)
    }


def ring_count(scan: Scan) -> int:
    """Count the rings of a scan by its highest ring index, or by its firing order if it names no rings."""
    scan = scan.measured()
    if scan.ring is not None:
        return int(scan.ring.max()) + 1
    return int(unfolding.rings_from_firing_order(scan.points_xyz_m.numpy().T)[-1]) + 1


def elevation_span_deg(scan: Scan) -> tuple[float, float]:
    """Return the 1 % and the 99 % quantile of the elevations of the points, in degrees."""
    low, high = np.quantile(elevations_deg(scan.points_xyz_m), (0.01, 0.99))
    return float(low), float(high)


def elevations_deg(points_xyz_m: Tensor) -> np.ndarray:
    """Return the elevation of points (n, 3) in degrees, (n,)."""
    x, y, z = points_xyz_m.double().numpy().T  # in 32 bits, squares of huge numbers overflow
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
        "use the uncropped scan, or have the rest filled in with: lidargrit complete SCAN OUT --observed returns",
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
    if scan.ring is None and not _is_ring_by_ring(scan, pixels.row):
        return _no_firing_order(scan)
    return ScanError(
        f"{rings} rings in {scan.source}",
        f"the {sensor.height} rings of the sensor {sensor.name!r}, in firing order",
        f"{_name_sensor(scan, sensor)}; remove the file if the scan was cut; {_BY_ELEVATION}",
    )


def _misplaced(
    scan: Scan, sensor: SensorModel, method: ProjectionName, pixels: PixelCoordinates, variant: ProjectionVariant
) -> ScanError | None:
    """Return the message about an image whose rows are not where its points lie."""
    if (method == "spherical" and variant != "reference") or not _is_misplaced(scan, sensor, pixels.row):
        return None  # rows by elevation are right by themselves
    if method == "unfolding" and scan.ring is None:
        return _no_firing_order(scan)
    what = "rings" if method == "unfolding" else "rows of LidarGRIT's fixed field of view"
    return ScanError(
        f"{what} that lie elsewhere than those of {sensor.name!r}, in {scan.source}",
        "a scan of this sensor",
        _name_sensor(scan, sensor)
        if method == "unfolding"
        else "choose --set data.projection_variant=exact (in Python: variant='exact')",
    )


def _no_firing_order(scan: Scan) -> ScanError:
    return ScanError(
        f"points that are not stored as they were fired, ring by ring from the highest, in {scan.source}",
        "points in firing order, or the ring of each, to put them into rows by ring",
        f"leave the scan out, or {_BY_ELEVATION}",
    )


def _is_misplaced(scan: Scan, sensor: SensorModel, row: Int[np.ndarray, "n"]) -> bool:
    """Return whether most points lie far from the elevation of the row that they are put into."""
    if len(scan) < _POINTS_FOR_ORDER:
        return False
    step = max(1, len(scan) // _POINTS_MEASURED)
    rays_deg = np.degrees(row_elevation_rad(sensor))
    some = row[::step]
    off_deg = np.abs(elevations_deg(scan.points_xyz_m[::step]) - rays_deg[np.clip(some, 0, sensor.height - 1)])
    off_deg[(some < 0) | (some >= sensor.height)] = np.inf
    bottom_deg, top_deg = _span_of_rows_deg(sensor)
    return bool(np.median(off_deg) > _MISPLACED_AT_MOST * (top_deg - bottom_deg))


def known_rings(scan: Scan) -> Int[np.ndarray, "n"] | None:
    """Return the ring of each point, as the file or its firing order tells; None where neither does."""
    return _rings_in_order(scan) if scan.ring is None else scan.ring.numpy()


def _rings_in_order(scan: Scan) -> Int[np.ndarray, "n"] | None:
    """Return the ring of each point of a scan that is stored as it was fired; None where it is not."""
    ring = unfolding.rings_from_firing_order(np.ascontiguousarray(scan.points_xyz_m.numpy().T))
    return ring if _is_ring_by_ring(scan, ring) else None


def _is_ring_by_ring(scan: Scan, ring: Int[np.ndarray, "n"]) -> bool:
    """Return whether rings that were found in the order of the points each keep to one elevation."""
    elevation_deg = elevations_deg(scan.points_xyz_m)
    points = np.maximum(np.bincount(ring), 1)
    mean_deg = np.bincount(ring, elevation_deg) / points
    within = np.square(elevation_deg - mean_deg[ring]).mean()
    return bool(within <= _WITHIN_RINGS_AT_MOST * elevation_deg.var())


def _wrong_elevations(scan: Scan, sensor: SensorModel, outside: float) -> ScanError:
    low_deg, high_deg = elevation_span_deg(scan)
    bottom_deg, top_deg = _span_of_rows_deg(sensor)
    return ScanError(
        f"{outside:.0%} of the points of {scan.source} outside the sensor's elevations (the scan spans "
        f"{low_deg:.1f} to {high_deg:.1f} degrees)",
        f"{bottom_deg:.1f} to {top_deg:.1f} degrees for {sensor.name!r}",
        told_height(scan, sensor) or _name_sensor(scan, sensor),
    )


def _name_sensor(scan: Scan, refused: SensorModel) -> str:
    """Return the cure for a scan that another sensor has made."""
    of_run = f"a run has its own sensor, which sees scans by: lidargrit rescan SCANS SEEN --to {refused.name}"
    if fitting := " or ".join(name for name in sensors_that_fit(scan) if name != refused.name):
        return f"{_NAME_IT} ({fitting}, {FIT_SENSOR}); {of_run}"
    return f"{_NAME_IT}; none in the package is like it: {FIT_SENSOR.removeprefix('or ')}; {of_run}"


def _span_of_rows_deg(sensor: SensorModel) -> tuple[float, float]:
    edges_deg = np.degrees(spherical.row_edges_rad(row_elevation_rad(sensor)))
    return float(edges_deg[-1]), float(edges_deg[0])
