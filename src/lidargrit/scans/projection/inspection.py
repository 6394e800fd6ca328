"""Losses and errors of a projection: scan, sensor → :class:`Inspection`."""

from dataclasses import asdict, astuple, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int8, Int64

from lidargrit.core.table import Table, render
from lidargrit.scans.projection.frame import told_height
from lidargrit.scans.projection.pixel_coordinates import (
    PixelCoordinates,
    ProjectionVariant,
    pixel_coordinates,
    within_limits,
)
from lidargrit.scans.projection.revolutions import told_revolutions
from lidargrit.scans.projection.sensor_check import fit_problems, ring_count
from lidargrit.scans.sensors import ProjectionName, SensorModel
from lidargrit.scans.types import Scan

FATES = {
    "above": "above the rows",
    "below": "below the rows",
    "nearer": "nearer than the limits",
    "farther": "farther than the limits",
    "left_out": "in columns left out",
    "hidden": "behind a nearer point",
    "kept": "kept",
}
"""Fates of a point, in the order in which they are decided, and their names in the table."""

_ABOVE, _BELOW, _NEARER, _FARTHER, _LEFT_OUT, _HIDDEN, _KEPT = range(len(FATES))


@dataclass(frozen=True)
class ErrorSummary:
    """Median, 95 % quantile and maximum of many absolute errors."""

    median: float
    percentile_95: float
    largest: float


@dataclass(frozen=True, eq=False)
class Inspection:
    """Result of a projection: the fate of every point, the image, and the errors of unprojection.

    Args:
        scan: scan that was projected.
        method: projection method, ``spherical`` or ``unfolding``.
        variant: variant of the projection, as of :func:`project`.
        fate: index into FATES (n,) of every point.
        range_m: range image (H, W) in metres, 0 where there is no return.
        points_per_pixel: number of points (H, W) that fall into each pixel.
        errors: differences between the kept points and their pixels unprojected: ``range_m``; ``position_m``, the
            distance; and its parts ``across`` (azimuth) and ``up`` (elevation), as arcs in metres and in degrees.
            Empty if no point is kept.
        rings: number of rings of the scan, for ``unfolding`` only.
        problems: reasons for which :func:`project` would refuse the scan, and signs of several
            revolutions or of another frame.
    """

    scan: Scan
    sensor: SensorModel
    method: ProjectionName
    variant: ProjectionVariant
    fate: Int8[np.ndarray, "n"]
    range_m: Float32[np.ndarray, "H W"]
    points_per_pixel: Int64[np.ndarray, "H W"]
    errors: dict[str, ErrorSummary]
    rings: int | None
    problems: tuple[str, ...]

    def counts(self) -> dict[str, int]:
        """Return the number of points of each fate; they add up to all points."""
        return dict(zip(FATES, np.bincount(self.fate, minlength=len(FATES)).tolist(), strict=True))

    def filled(self) -> Bool[np.ndarray, "H W"]:
        """Return which pixels have a return."""
        return self.range_m > 0


def inspect(
    scan: Scan, sensor: SensorModel, method: ProjectionName | None = None, variant: ProjectionVariant = "exact"
) -> Inspection:
    """Find the fate of every point of a scan, and measure how far unprojection moves the points that are kept.

    A scan that does not fit is projected as far as possible; ``problems`` says what is wrong.

    Args:
        scan, sensor, method, variant: the arguments of :func:`project`.

    Raises:
        ConfigError: no method or variant of that name.
    """
    method = method or sensor.projection
    pixels = pixel_coordinates(scan, sensor, method, variant)
    problems = [str(problem) for problem in fit_problems(scan, sensor, method, pixels, variant=variant)]
    problems += filter(None, [told_revolutions(scan), told_height(scan, sensor)])
    fate, wanted = _fates(pixels, sensor, variant)
    kept = np.flatnonzero(fate == _KEPT)
    if not len(kept):
        problems.append(f"no point of {scan.source} is kept, so there is no image")
    row, column = pixels.row[kept], pixels.column[kept] // sensor.column_stride
    range_m = np.zeros((sensor.height, sensor.width), dtype=np.float32)
    range_m[row, column] = pixels.range_m[kept]
    pixel = pixels.row[wanted].astype(np.int64) * sensor.width + pixels.column[wanted] // sensor.column_stride
    return Inspection(
        scan,
        sensor,
        method,
        variant,
        fate,
        range_m,
        np.bincount(pixel, minlength=range_m.size).reshape(range_m.shape),
        _errors(scan.points_xyz_m.numpy()[kept], pixels.range_m[kept], row, column, sensor) if len(kept) else {},
        ring_count(scan) if method == "unfolding" else None,
        tuple(problems),
    )


def as_json(inspection: Inspection) -> dict[str, Any]:
    """Return an inspection as plain numbers and words."""
    filled = inspection.filled()
    return {
        "scan": inspection.scan.source,
        "notes": list(inspection.scan.notes),
        "sensor": inspection.sensor.name,
        "image": list(filled.shape),
        "projection": inspection.method,
        "variant": inspection.variant,
        "problems": list(inspection.problems),
        "rings": inspection.rings,
        "points": {"all": len(inspection.scan), **inspection.counts()},
        "filled": float(filled.mean()),
        "filled_by_row": filled.mean(axis=1).tolist(),
        "errors": {name: asdict(summary) for name, summary in inspection.errors.items()},
    }


def as_table(inspection: Inspection) -> str:
    """Return an inspection as tables of about 25 lines together."""
    sensor, filled, total = inspection.sensor, inspection.filled(), len(inspection.scan)
    stride = f", one in {sensor.column_stride} of its columns" if sensor.column_stride > 1 else ""
    size = f"{sensor.height}x{sensor.width} of {sensor.name}{stride}"
    sentences = [inspection.scan.source, *(f"note: {note}" for note in inspection.scan.notes)]
    sentences.append(f"{inspection.method}, {inspection.variant}, to {size}")
    sentences += [f"problem: {problem}" for problem in inspection.problems]
    if inspection.rings is not None:
        sentences.append(f"{inspection.rings} rings found, {sensor.height} rows")
    counts = {name: count for name, count in inspection.counts().items() if count or name == "kept"}
    fates = [(FATES[name], f"{count}", f"{count / total:.2%}") for name, count in counts.items()]
    parts = zip(("top", "second", "third", "lowest"), np.array_split(filled, 4), strict=True)
    quarters = [(f"{which} quarter of the rows", *_filling(part)) for which, part in parts if len(part)]
    empty = np.flatnonzero(~filled.any(axis=1))
    shown = ", ".join(map(str, empty[:12])) + (", ..." if len(empty) > 12 else "")
    errors = [
        (f"{name.rpartition('_')[0]} [{name.rpartition('_')[2]}]", *(f"{each:.4f}" for each in astuple(summary)))
        for name, summary in inspection.errors.items()
    ]
    tables = [
        Table(("points", f"{total}", "share"), tuple(fates), sentences=tuple(sentences)),
        Table(
            ("pixels filled", *_filling(filled)),
            tuple(quarters),
            notes=(f"{len(empty)} {'rows are' if len(empty) > 1 else 'row is'} empty: {shown}",) if len(empty) else (),
        ),
    ]
    if errors:
        tables.append(Table(("unprojected, off by", "median", "95 %", "most"), tuple(errors)))
    return render(tables)


def _filling(filled: Bool[np.ndarray, "h W"]) -> tuple[str, str]:
    return f"{int(filled.sum())}", f"{filled.mean():.2%}"


def _fates(
    pixels: PixelCoordinates, sensor: SensorModel, variant: ProjectionVariant
) -> tuple[Int8[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Return the fate of every point, and which points fall into a pixel of the image."""
    in_rows, in_limits = pixels.in_rows(), within_limits(pixels.range_m, sensor)
    eligible = in_rows & in_limits if variant == "exact" else np.ones_like(in_rows)
    winner, _ = pixels.nearest(eligible)
    wanted = eligible & (pixels.column % sensor.column_stride == 0)
    fate = np.full(len(pixels.row), _HIDDEN, dtype=np.int8)
    fate[winner[winner >= 0]] = _KEPT
    fate[eligible & ~wanted] = _LEFT_OUT
    # Programs apply the limits to the winners only, and the reference strictly.
    under, over = (np.less_equal, np.greater_equal) if variant == "reference" else (np.less, np.greater)
    decided = fate == _KEPT if variant != "exact" else np.ones_like(in_rows)
    fate[decided & under(pixels.range_m, sensor.range_min_m)] = _NEARER
    fate[decided & over(pixels.range_m, sensor.range_max_m)] = _FARTHER
    if variant == "exact":
        fate[pixels.row < 0] = _ABOVE
        fate[pixels.row >= pixels.height] = _BELOW
    return fate, wanted


def _errors(
    xyz_m: Float32[np.ndarray, "k 3"],
    range_m: Float32[np.ndarray, "k"],
    row: np.ndarray,
    column: np.ndarray,
    sensor: SensorModel,
) -> dict[str, ErrorSummary]:
    """Compare points with those that their pixels unproject to; an arc is the angle times its radius."""
    again_m = sensor.ray_directions().numpy()[row, column].astype(np.float64) * range_m[:, None]
    azimuth_rad, elevation_rad, exact_range_m = _spherical(xyz_m.astype(np.float64))
    again_azimuth_rad, again_elevation_rad, again_range_m = _spherical(again_m)
    across_rad = (azimuth_rad - again_azimuth_rad + np.pi) % (2 * np.pi) - np.pi
    up_rad = elevation_rad - again_elevation_rad
    errors = {
        "range_m": again_range_m - exact_range_m,
        "position_m": np.sqrt(((again_m - xyz_m) ** 2).sum(axis=1)),
        "across_m": across_rad * np.hypot(xyz_m[:, 0], xyz_m[:, 1]),
        "up_m": up_rad * exact_range_m,
        "across_deg": np.degrees(across_rad),
        "up_deg": np.degrees(up_rad),
    }
    return {name: _summarise(np.abs(error)) for name, error in errors.items()}


def _spherical(xyz_m: Float64[np.ndarray, "k 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x, y, z = xyz_m.T
    level_m = np.hypot(x, y)
    return np.arctan2(y, x), np.arctan2(z, level_m), np.hypot(level_m, z)


def _summarise(error: np.ndarray) -> ErrorSummary:
    median, percentile_95 = np.quantile(error, (0.5, 0.95))
    return ErrorSummary(float(median), float(percentile_95), float(error.max()))
