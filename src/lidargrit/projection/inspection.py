"""What a projection keeps of a scan and how well: scan, sensor → :class:`Inspection`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int8, Int64

from lidargrit.projection.fit import misfits, ring_count
from lidargrit.projection.placement import Placement, Variant, place, within_limits
from lidargrit.sensors import ProjectionName, SensorModel
from lidargrit.structures import Scan

FATES = {
    "above": "above the rows",
    "below": "below the rows",
    "nearer": "nearer than the limits",
    "farther": "farther than the limits",
    "left_out": "in columns left out",
    "hidden": "behind a nearer point",
    "kept": "kept",
}
"""What becomes of a point, in the order in which it is decided, and how the table calls it."""

_ABOVE, _BELOW, _NEARER, _FARTHER, _LEFT_OUT, _HIDDEN, _KEPT = range(len(FATES))


@dataclass(frozen=True)
class Spread:
    """The middle, the 95 % quantile and the largest of many absolute errors."""

    median: float
    percentile_95: float
    largest: float


@dataclass(frozen=True, eq=False)
class Inspection:
    """What a projection makes of a scan.

    Args:
        scan: the points.
        sensor: the rays of the image.
        method: projection method, ``spherical`` or ``unfolding``.
        variant: variant of the projection, ``exact`` or ``reference``.
        fate: index into FATES (n,) of every point.
        range_m: the range image, 0 where there is no return.
        points_per_pixel: number of points (H, W) that fall into each pixel.
        errors: differences between the kept points and their pixels unprojected: ``range_m``; ``position_m``, the
            distance; and its parts ``across`` (azimuth) and ``up`` (elevation), as arcs in metres and in degrees.
            Empty if no point is kept.
        rings: number of rings of the scan, for ``unfolding`` only.
        problems: why :func:`project` would refuse the scan; empty if it would not.
    """

    scan: Scan
    sensor: SensorModel
    method: ProjectionName
    variant: Variant
    fate: Int8[np.ndarray, "n"]
    range_m: Float32[np.ndarray, "H W"]
    points_per_pixel: Int64[np.ndarray, "H W"]
    errors: dict[str, Spread]
    rings: int | None
    problems: tuple[str, ...]

    def counts(self) -> dict[str, int]:
        """Return how many points met each fate; together they are all."""
        return dict(zip(FATES, np.bincount(self.fate, minlength=len(FATES)).tolist(), strict=True))

    def filled(self) -> Bool[np.ndarray, "H W"]:
        """Tell which pixels have a return."""
        return self.range_m > 0


def inspect(
    scan: Scan, sensor: SensorModel, method: ProjectionName | None = None, variant: Variant = "exact"
) -> Inspection:
    """Count what becomes of every point of a scan, and measure where the image puts those that it keeps.

    A scan that does not fit is projected as far as it goes, and what is wrong stands in ``problems``.

    Args:
        scan, sensor, method, variant: the arguments of :func:`project`.
    """
    method = method or sensor.projection
    placed = place(scan, sensor, method, variant)
    problems = [str(misfit) for misfit in misfits(scan, sensor, method, placed)] if variant == "exact" else []
    fate, wanted = _fates(placed, sensor, variant)
    kept = np.flatnonzero(fate == _KEPT)
    if not len(kept):
        problems.append(f"no point of {scan.source} is kept, so there is no image")
    row, column = placed.row[kept], placed.column[kept] // sensor.column_stride
    range_m = np.zeros((sensor.height, sensor.width), dtype=np.float32)
    range_m[row, column] = placed.range_m[kept]
    pixel = placed.row[wanted].astype(np.int64) * sensor.width + placed.column[wanted] // sensor.column_stride
    return Inspection(
        scan,
        sensor,
        method,
        variant,
        fate,
        range_m,
        np.bincount(pixel, minlength=range_m.size).reshape(range_m.shape),
        _errors(scan.points_xyz_m.numpy()[kept], placed.range_m[kept], row, column, sensor) if len(kept) else {},
        ring_count(scan) if method == "unfolding" else None,
        tuple(problems),
    )


def as_json(inspection: Inspection) -> dict[str, Any]:
    """Return the figures of an inspection as plain numbers and words."""
    filled = inspection.filled()
    return {
        "scan": inspection.scan.source,
        "sensor": inspection.sensor.name,
        "image": list(filled.shape),
        "projection": inspection.method,
        "variant": inspection.variant,
        "problems": list(inspection.problems),
        "rings": inspection.rings,
        "points": {"all": len(inspection.scan), **inspection.counts()},
        "filled": float(filled.mean()),
        "filled_by_row": filled.mean(axis=1).tolist(),
        "errors": {name: asdict(spread) for name, spread in inspection.errors.items()},
    }


def as_table(inspection: Inspection) -> str:
    """Return the figures of an inspection for the eye, in about 25 lines."""
    return "\n".join(_lines(inspection))


def _lines(inspection: Inspection) -> Iterator[str]:
    sensor, filled, total = inspection.sensor, inspection.filled(), len(inspection.scan)
    yield inspection.scan.source
    stride = f", every {sensor.column_stride}th of its columns" if sensor.column_stride > 1 else ""
    yield f"{inspection.method}, {inspection.variant}, to {sensor.height}x{sensor.width} of {sensor.name}{stride}"
    yield from (f"problem: {problem}" for problem in inspection.problems)
    if inspection.rings is not None:
        yield f"{inspection.rings} rings found, {sensor.height} rows"
    yield f"\n{'points':<28}{total:>9}"
    for name, count in inspection.counts().items():
        if count or name == "kept":
            yield f"  {FATES[name]:<26}{count:>9}{count / total:>9.2%}"
    yield f"\n{'pixels filled':<28}{int(filled.sum()):>9}{filled.mean():>9.2%}"
    shares = filled.mean(axis=1)
    for which, of in zip(("top", "second", "third", "lowest"), np.array_split(shares, 4), strict=True):
        if len(of):
            yield f"  {which + ' quarter of the rows':<26}{'':>9}{of.mean():>9.2%}"
    empty = np.flatnonzero(shares == 0)
    if len(empty):
        shown = ", ".join(map(str, empty[:12])) + (", ..." if len(empty) > 12 else "")
        yield f"  {len(empty)} rows are empty: {shown}"
    if inspection.errors:
        yield f"\n{'unprojected, off by':<28}{'median':>9}{'95 %':>9}{'most':>9}"
    for name, spread in inspection.errors.items():
        quantity, _, unit = name.rpartition("_")
        numbers = (spread.median, spread.percentile_95, spread.largest)
        yield f"  {quantity + ' [' + unit + ']':<26}" + "".join(f"{number:>9.4f}" for number in numbers)


def _fates(
    placed: Placement, sensor: SensorModel, variant: Variant
) -> tuple[Int8[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Return the fate of every point, and which points wanted a pixel of the image."""
    in_rows, in_limits = placed.in_rows(), within_limits(placed.range_m, sensor)
    # The reference applies the limits to the winners only, and strictly.
    eligible = in_rows & in_limits if variant == "exact" else np.ones_like(in_rows)
    winner, _ = placed.nearest(eligible)
    wanted = eligible & (placed.column % sensor.column_stride == 0)
    fate = np.full(len(placed.row), _HIDDEN, dtype=np.int8)
    fate[winner[winner >= 0]] = _KEPT
    if variant == "reference":
        fate[(fate == _KEPT) & (placed.range_m <= sensor.range_min_m)] = _NEARER
        fate[(fate == _KEPT) & (placed.range_m >= sensor.range_max_m)] = _FARTHER
    fate[eligible & ~wanted] = _LEFT_OUT
    if variant == "exact":
        fate[placed.range_m < sensor.range_min_m] = _NEARER
        fate[placed.range_m > sensor.range_max_m] = _FARTHER
        fate[placed.row < 0] = _ABOVE
        fate[placed.row >= placed.height] = _BELOW
    return fate, wanted


def _errors(
    xyz_m: Float32[np.ndarray, "k 3"],
    range_m: Float32[np.ndarray, "k"],
    row: np.ndarray,
    column: np.ndarray,
    sensor: SensorModel,
) -> dict[str, Spread]:
    """Compare points with those that their pixels unproject to; an arc is the angle times the radius it is seen at."""
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
    return {name: _spread(np.abs(error)) for name, error in errors.items()}


def _spherical(xyz_m: Float64[np.ndarray, "k 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x, y, z = xyz_m.T
    level_m = np.hypot(x, y)
    return np.arctan2(y, x), np.arctan2(z, level_m), np.hypot(level_m, z)


def _spread(error: np.ndarray) -> Spread:
    median, percentile_95 = np.quantile(error, (0.5, 0.95))
    return Spread(float(median), float(percentile_95), float(error.max()))
