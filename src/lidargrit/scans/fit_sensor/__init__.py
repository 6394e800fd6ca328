"""Scans of an unknown sensor → its :class:`SensorModel`, with the evidence for and against the fit."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64, Int64

from lidargrit.core import discovery
from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import ConfigError, ScanError
from lidargrit.scans.fit_sensor.azimuths import columns_of_scans, firing_steps_deg, first_edge_rad, offsets_deg
from lidargrit.scans.fit_sensor.elevations import FittedRows, cluster_rows, nearest_row, rows_of_rings
from lidargrit.scans.fit_sensor.points import NOISE_RANGE_M, Points
from lidargrit.scans.fit_sensor.rings import Method, Rings, recover_rings
from lidargrit.scans.fit_sensor.setup import fit_setup
from lidargrit.scans.many_scans import ManyScans, untold, usable_scans
from lidargrit.scans.projection.frame import told_height
from lidargrit.scans.projection.pixel_coordinates import row_elevation_rad
from lidargrit.scans.projection.revolutions import told_revolutions
from lidargrit.scans.projection.sensor_check import closest_sensor
from lidargrit.scans.sensors import (
    NAME_AT_MOST,
    REACH_AT_MOST_M,
    ProjectionName,
    SensorModel,
    column_azimuths_rad,
    load_sensor,
)
from lidargrit.scans.types import Scan

_SAME_AT_MOST = 0.25  # of the usual step between rows, in the mean: half of it would be the neighbours'


def notes_on_sensor(rows: FittedRows, rings: Rings) -> Iterator[str]:
    """Yield what is known of a sensor from elsewhere: its name, and in which direction such sensors turn.

    The lidars of Velodyne, Hesai and Ouster turn clockwise, seen from above. Files that keep one firing after another
    show it; those that are sorted ring by ring may be sorted either way.
    """
    fitted_deg = rows.elevation_deg
    step_deg = float(np.median(np.abs(np.diff(fitted_deg))))
    off_deg = {
        name: float(np.abs(fitted_deg - np.degrees(row_elevation_rad(sensor))).mean())
        for name in discovery.names("sensors")
        if (sensor := load_sensor(name)).height == len(fitted_deg)
    }
    nearest = min(off_deg, key=lambda name: off_deg[name], default="")
    if nearest and off_deg[nearest] < _SAME_AT_MOST * step_deg:
        how = f"its rows lie {off_deg[nearest]:.2f} degrees from these in the mean"
        yield f"the package has this sensor: {nearest} ({how}); --sensor {nearest} needs no file"
    if rings.lasers and rings.counter_clockwise:
        yield (
            "it turns counter-clockwise, seen from above, where lidars turn clockwise: the files may be mirrored (y to "
            "the right, as CARLA has it), or the sensor hangs upside down"
        )


_STEPS_M = (0.02, 0.012, 0.01, 0.008, 0.005, 0.004, 0.003, 0.002, 0.001)  # in which sensors and files count
_NEAR_A_STEP = 0.1  # of a step to either side; numbers that know no step are there at every fifth
_SHARE_AT_LEAST = 0.8


def farthest_m(range_m: Float64[np.ndarray, "n"]) -> float:
    """Return a limit that holds all points but one in ten thousand, rounded up to whole metres.

    Scans tell no near limit: other scans of the same sensor may have returns nearer than the nearest of these.
    """
    far_m = float(np.quantile(range_m, 0.9999))
    if far_m > REACH_AT_MOST_M:
        got = f"{(range_m > REACH_AT_MOST_M).sum():,} points beyond {REACH_AT_MOST_M:,} m"
        raise ScanError(got, "the reach of a sensor, in metres", "leave them out of the files, or check the unit")
    return float(math.ceil(far_m))


def quantum_m(values_m: Float64[np.ndarray, "n"]) -> float | None:
    """Return the largest step, in metres, of which nearly all values are whole multiples; None if there is none."""
    for step_m in _STEPS_M:
        off = np.abs(values_m / step_m - np.round(values_m / step_m))
        if float((off < _NEAR_A_STEP).mean()) > _SHARE_AT_LEAST:
            return step_m
    return None


__all__ = ["SensorFit", "fit_sensor", "fit_sensor_to_dataset"]

_HALVED = 8  # networks halve the columns up to three times
_COLUMNS_UNCLEAR = 1024  # what most range images of the literature have
_AGREE_AT_LEAST = 0.4  # motion-corrected scans of KITTI reach 0.6, points seen from another place 0.1
_FEW_SCANS = 5  # a moving car tilts, and its far rings meet little: one scan shows both
_SHIFT_ASIDE_DEG = 0.3  # offsets below this are the turning of the sensor while it fires
_STEPS_KEPT = 100_000  # for the picture


@dataclass(frozen=True, eq=False)
class SensorFit:
    """A sensor that was found in its scans, and the evidence.

    Args:
        sensor: fitted sensor; its rows lie where returns are seen from the origin.
        method: way in which the laser of every point was found.
        num_scans: number of scans that were used.
        laser_elevation_deg: elevations (H,) of the lasers, which the elevations of far points approach; a maker's table
            holds these.
        laser_height_m: height of every laser above the origin (H,), found from near points; all 0 if none is found.
        residual_deg: robust standard deviation of the elevations of every row's points (H,).
        points_per_ring: number of points of each ring (H,), over all scans.
        agree_share: share of the points that lie within a quarter of the row spacing of their row.
        counter_clockwise: whether the sensor turns counter-clockwise, seen from above; None if the order of points does
            not show it.
        start_deg: azimuth where a revolution begins in the file; None if unknown.
        range_step_m: step of which all ranges are multiples, in metres; None if there is none.
        coordinate_step_m: step of which all coordinates are multiples, in metres; None if there is none.
        elevations_deg: elevations (n,) of the points that were used, for a plot.
        steps_deg: steps in azimuth (m,) between neighbouring points of a ring, for a plot.
        warnings: sentences that the user should read.
    """

    sensor: SensorModel
    method: Method
    num_scans: int
    laser_elevation_deg: Float64[np.ndarray, "H"]
    laser_height_m: Float64[np.ndarray, "H"]
    residual_deg: Float64[np.ndarray, "H"]
    points_per_ring: Int64[np.ndarray, "H"]
    agree_share: float
    counter_clockwise: bool | None
    start_deg: float | None
    range_step_m: float | None
    coordinate_step_m: float | None
    elevations_deg: Float64[np.ndarray, "n"]
    steps_deg: Float64[np.ndarray, "m"]
    warnings: tuple[str, ...]


def fit_sensor(scans: Sequence[Scan], name: str = "fitted") -> SensorFit:
    """Find the sensor that made scans: its rows, columns, limits, how it turns, and the set-up of its unit.

    Args:
        scans: scans of one sensor in its own frame, best five or more from different places.
        name: name of the new sensor.

    Raises:
        ConfigError: no scan, or a name that is blank, too long or cannot be printed in one line.
        ScanError: scans that do not show their sensor: one ring, a camera's crop, a map, points of another frame.

    Example:
        >>> from lidargrit import simulate
        >>> fit_sensor([simulate(seed) for seed in range(2)]).sensor.height
        64
    """
    _check_name(name)
    if not scans:
        raise ConfigError("no scan to fit a sensor to", "at least one", "name a source that holds some")
    everything = [Points.of_scan(scan) for scan in scans]
    rings = recover_rings(everything)
    rows, rings = _rows_by_order(everything, rings) if rings else (None, None)
    if rows is None or rings is None:
        rows, rings = _rows_by_elevation(everything, scans[0])
    used = [everything[index] for index in rings.used]
    if len(rows.elevation_deg) < 2 or rows.agree_share < _AGREE_AT_LEAST:
        raise ScanError(
            f"points of {len(rows.elevation_deg)} rings, {rows.agree_share:.0%} of them near their ring's elevation, "
            f"in {scans[0].source}",
            "rings of points as a turning sensor with several lasers sees them from its own place",
            "give scans in the sensor's own frame, of one sensor, each of one revolution" + _seen_from(scans[0]),
        )
    row_of_point = tuple(_row_numbers(rows, number) for number in rings.of_point)
    steps = firing_steps_deg(used, row_of_point)
    columns = columns_of_scans(used, row_of_point, steps)
    sensor = _model(name, rows, columns, used, row_of_point, rings)
    setup, assumed = fit_setup([scans[index] for index in rings.used], sensor)
    sensor = replace(sensor, setup=setup)
    doubts = (*notes_on_sensor(rows, rings), *_warnings(rows, rings, len(scans), columns), *assumed)
    return SensorFit(
        sensor=sensor,
        method=rings.method,
        num_scans=len(used),
        laser_elevation_deg=rows.laser_elevation_deg,
        laser_height_m=rows.laser_height_m,
        residual_deg=rows.residual_deg,
        points_per_ring=rows.num_points,
        agree_share=rows.agree_share,
        counter_clockwise=rings.counter_clockwise,
        start_deg=rings.start_deg,
        range_step_m=quantum_m(np.concatenate([points.range_m for points in used])),
        coordinate_step_m=quantum_m(np.concatenate([scan.points_xyz_m.double().numpy().ravel() for scan in scans])),
        elevations_deg=np.concatenate([points.elevation_deg for points in used]),
        steps_deg=steps[:: max(1, len(steps) // _STEPS_KEPT)],
        warnings=(*_notes_of(scans), *doubts),
    )


def fit_sensor_to_dataset(
    dataset: ManyScans, name: str = "fitted", num_scans: int = 20, bad_scans: Literal["refuse", "skip"] = "refuse"
) -> SensorFit:
    """Find the sensor that made the scans of a data set, from some of them, evenly spaced.

    Args:
        dataset: scans, see :func:`lidargrit.data.datasets.open_dataset`.
        num_scans: largest number of scans to use; 0 for all.
        bad_scans: ``refuse`` to go on when a scan cannot be used, or ``skip`` it with a warning.
    """
    if num_scans < 0:
        raise ConfigError(f"-n {num_scans}", "at least 1 scan, or 0 for all", "raise it")
    _check_name(name)
    indices = evenly_spaced(num_scans or len(dataset), len(dataset))
    skipped: tuple[str, ...] = ()
    if bad_scans == "refuse":
        scans = [dataset.scan(index) for index in indices]
    else:
        scans, skipped = usable_scans(dataset, indices)
    fit = fit_sensor(scans, name)
    return replace(fit, warnings=(*dataset.notes, *skipped, *fit.warnings))


def _check_name(name: str) -> None:
    """Refuse a name with which no command would read the sensor's file."""
    if not (name.strip() and name.isprintable()):
        raise ConfigError(f"--name {name!r}", "a name in one line that is not blank", "choose another")
    if len(name) > NAME_AT_MOST:
        raise ConfigError(f"a name of {len(name)} letters", f"at most {NAME_AT_MOST}", "choose a shorter --name")
    if name in discovery.names("sensors"):
        raise ConfigError(f"the name {name}, which a sensor of the package has", "another one", "give one by --name")


def _rows_by_order(scans: Sequence[Points], rings: Rings) -> tuple[FittedRows | None, Rings | None]:
    """Fit rows to recovered rings; nothing if the order of the points was misread."""
    used = [scans[index] for index in rings.used]
    elevation = np.concatenate([points.elevation_deg for points in used])
    range_m = np.concatenate([points.range_m for points in used])
    rows = rows_of_rings(elevation, range_m, np.concatenate(rings.of_point))
    in_order = np.diff(rows.number)
    if rings.method == "ring by ring" and not ((in_order > 0).all() or (in_order < 0).all()):
        return None, None  # a file sorted ring by ring is sorted by elevation too; this one is sorted otherwise
    return rows, rings


def _rows_by_elevation(scans: Sequence[Points], first: Scan) -> tuple[FittedRows, Rings]:
    """Find rows where elevations gather, and give every point the nearest."""
    elevation = np.concatenate([points.elevation_deg for points in scans])
    range_m = np.concatenate([points.range_m for points in scans])
    peaks, share = cluster_rows(elevation, range_m)
    if len(peaks) < 2:
        raise ScanError(
            f"no rings in {first.source}: its elevations do not gather",
            "points of a turning sensor, seen from its own place",
            "give single scans, not maps, in the sensor's own frame and in the order in which they were fired"
            + _seen_from(first),
        )
    numbers = tuple(nearest_row(points.elevation_deg, peaks) for points in scans)
    rows = rows_of_rings(elevation, range_m, np.concatenate(numbers))
    rows = replace(rows, agree_share=share)
    return rows, Rings("elevation clusters", numbers, tuple(range(len(scans))))


def _seen_from(scan: Scan) -> str:
    """Return what is known of the place from which a sensor of the package saw a scan, as the end of a message."""
    told = told_height(scan, load_sensor(closest_sensor(scan)))
    return f" ({told})" if told else ""


def _row_numbers(rows: FittedRows, number: Int64[np.ndarray, "n"]) -> Int64[np.ndarray, "n"]:
    """Replace the rings' own numbers by rows counted from the top."""
    row_of = np.full(max(int(number.max()), int(rows.number.max())) + 1, -1)
    row_of[rows.number] = np.arange(len(rows.number))
    return row_of[number]


def _model(
    name: str,
    rows: FittedRows,
    columns: int | None,
    used: Sequence[Points],
    row_of_point: Sequence[Int64[np.ndarray, "_"]],
    rings: Rings,
) -> SensorModel:
    elevation_rad, offsets = torch.from_numpy(np.radians(rows.elevation_deg)).float(), None
    if not bool((falls := elevation_rad.diff() < 0).all()):
        above = int((~falls).nonzero()[0])
        one, other = sorted(rows.number[above : above + 2].tolist())
        got = f"rings {one} and {other}, both at {rows.elevation_deg[above]:.2f} degrees of elevation"
        raise ScanError(got, "a ring for each laser", "correct the rings of the files, or write them without any")
    if rings.lasers:
        offsets = offsets_deg(used, row_of_point, len(rows.number), rings.lasers)
        if offsets is not None and float(np.ptp(offsets)) < _SHIFT_ASIDE_DEG:
            offsets = None
    halved = _halved(columns or _COLUMNS_UNCLEAR)
    edge_rad = first_edge_rad(used, row_of_point, halved) if halved == columns else math.pi
    return SensorModel(
        name=name,
        elevation_rad=elevation_rad[:, None],
        azimuth_rad=column_azimuths_rad(halved, first_edge_rad=edge_rad),
        range_min_m=NOISE_RANGE_M,
        range_max_m=farthest_m(np.concatenate([points.range_m for points in used])),
        projection=_projection(rows, rings),
        source=f"lidargrit fit-sensor, from {len(used)} scans (rings: {rings.method})",
        azimuth_offset_rad=None if offsets is None else torch.from_numpy(np.radians(offsets)).float(),
        first_edge_rad=edge_rad,
    )


def _halved(columns: int) -> int:
    """Return the nearest number that networks can halve three times: four columns more or less, of hundreds."""
    return _HALVED * max(1, round(columns / _HALVED))


def _projection(rows: FittedRows, rings: Rings) -> ProjectionName:
    """Choose unfolding if the files give the ring of every point, by a field or by KITTI's order of points."""
    if rings.method == "ring field":
        return "unfolding" if _are_rows(rows) else "spherical"
    as_kitti = rings.method == "ring by ring" and rings.counter_clockwise and rings.start_deg == 0.0
    return "unfolding" if _are_rows(rows) and as_kitti else "spherical"


def _are_rows(rows: FittedRows) -> bool:
    """Return whether the numbers of the rings are those of the rows: from 0 for the highest, none left out."""
    return bool((rows.number == np.arange(len(rows.number))).all())


def _notes_of(scans: Sequence[Scan]) -> list[str]:
    """Return what readers say of the files, each sentence once, and whether a scan has several revolutions."""
    turns = next((told for scan in scans if (told := told_revolutions(scan))), "")
    return untold((*(note for scan in scans for note in scan.notes), *([turns] if turns else [])), set())


def _warnings(rows: FittedRows, rings: Rings, num_scans: int, columns: int | None) -> tuple[str, ...]:
    found = []
    if len(rings.used) < num_scans:
        left = num_scans - len(rings.used)
        found.append(f"{left} of {num_scans} scans have another number of rings than the rest, and were left out")
    if len(rings.used) < _FEW_SCANS:
        scans = "one scan" if len(rings.used) == 1 else f"{len(rings.used)} scans"
        found.append(f"only {scans}: rings that met little may be off; give {_FEW_SCANS} or more")
    if columns is None:
        found.append(f"the step between firings is not clear; {_COLUMNS_UNCLEAR} columns were assumed")
    elif _halved(columns) != columns:
        found.append(
            f"the sensor fires in {columns:,} columns; the file has {_halved(columns):,}, which networks can halve, so "
            f"that some points share a pixel (--set data.columns={columns} keeps them apart)"
        )
    if rings.method == "elevation clusters":
        found.append("the files do not tell which laser fired a point: rows are where elevations gather")
    poor = int((rows.num_points < 0.05 * np.median(rows.num_points)).sum())
    if poor:
        found.append(f"{poor} rings have few points, so that their elevations are uncertain")
    gap = np.abs(np.diff(rows.elevation_deg))
    blurred = int((rows.residual_deg[1:] > gap / 2).sum())
    if blurred:
        found.append(
            f"{blurred} rings are blurred by more than half the way to the next: fit scans in the sensor's own frame, "
            "without motion compensation (deskewing)"
        )
    if rings.method == "ring field" and not _are_rows(rows):
        found.append("the rings of the files are not numbered from 0 at the top without a gap, so rows go by elevation")
    return tuple(found)
