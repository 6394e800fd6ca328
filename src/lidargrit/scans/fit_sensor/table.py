"""A :class:`SensorFit` → a table of the fitted sensor and the quality of the fit, or the same as plain values."""

import math
from typing import Any

import numpy as np

from lidargrit.core.table import Table
from lidargrit.scans.fit_sensor import SensorFit
from lidargrit.scans.sensors import SensorSetup

_ROWS_SHOWN = 8  # spread over the sensor; the file and the picture have all


def as_table(fit: SensorFit) -> str:
    """Return the facts of a fit, one a line, and some of its rows."""
    sensor, step_m = fit.sensor, fit.range_step_m or fit.coordinate_step_m
    turning = {True: "counter-clockwise", False: "clockwise", None: "not known from the files"}[fit.counter_clockwise]
    start = "" if fit.start_deg is None else f", files begin at {fit.start_deg:.0f} degrees"
    of_what = "ranges" if fit.range_step_m else "coordinates"
    facts = {
        "rings": f"{sensor.height} ({fit.method}; scans: {fit.num_scans})",
        "columns": f"{sensor.width} ({360 / sensor.width:.3f} degrees)",
        "turns": f"{turning}{start}",
        "range": f"{sensor.range_min_m:g} to {sensor.range_max_m:g} m"
        + (f", {of_what} in steps of {step_m:g} m" if step_m else ""),
        "lasers": _lasers(fit),
        "unit": _unit(sensor.setup),
        "projection": sensor.projection,
        "agreement": f"{fit.agree_share:.1%} of the points lie close to their ring's elevation",
    }
    rows = [
        (
            f"{row}",
            f"{math.degrees(float(sensor.elevation_rad[row, 0])):.3f}",
            f"{fit.laser_elevation_deg[row]:.3f}",
            f"{fit.residual_deg[row]:.3f}",
            f"{fit.points_per_ring[row]}",
        )
        for row in np.unique(np.linspace(0, sensor.height - 1, _ROWS_SHOWN).round().astype(int))
    ]
    head = ("row", "elevation [deg]", "laser [deg]", "spread [deg]", "points")
    above = tuple(f"{name:<12}{fact}" for name, fact in facts.items())
    return Table(head, tuple(rows), sentences=above, notes=tuple(f"note: {each}" for each in fit.warnings)).as_text()


def as_json(fit: SensorFit) -> dict[str, Any]:
    """Return the sensor and the evidence for it, as plain values."""
    return {
        "sensor": fit.sensor.to_json(),
        "method": fit.method,
        "num_scans": fit.num_scans,
        "agree_share": fit.agree_share,
        "counter_clockwise": fit.counter_clockwise,
        "start_deg": fit.start_deg,
        "range_step_m": fit.range_step_m,
        "coordinate_step_m": fit.coordinate_step_m,
        "laser_elevation_deg": fit.laser_elevation_deg.tolist(),
        "laser_height_m": fit.laser_height_m.tolist(),
        "residual_deg": fit.residual_deg.tolist(),
        "points_per_ring": fit.points_per_ring.tolist(),
        "warnings": list(fit.warnings),
    }


def _unit(setup: SensorSetup | None) -> str:
    if setup is None:
        return "too few planes to tell its noise"
    noise_cm, growth_mm, offsets_cm = (
        100 * setup.range_sigma_m,
        1000 * setup.range_sigma_per_m,
        100 * np.std(setup.offset_m),
    )
    noise = f"range noise {noise_cm:.1f} cm and {growth_mm:.1f} mm a metre"
    return f"{noise}, lasers {offsets_cm:.1f} cm apart, {setup.height_m:.2f} m above the ground"


def _lasers(fit: SensorFit) -> str:
    """Describe the heights and azimuth offsets of the lasers, as far as the points show them."""
    found = []
    if np.any(fit.laser_height_m):
        low_m, high_m = fit.laser_height_m.min(), fit.laser_height_m.max()
        found.append(f"{low_m * 100:.1f} to {high_m * 100:.1f} cm above the origin")
    if fit.sensor.azimuth_offset_rad is not None:
        low, high = (math.degrees(float(value)) for value in fit.sensor.azimuth_offset_rad.aminmax())
        found.append(f"{low:.2f} to {high:.2f} degrees aside of their column")
    return ", ".join(found) or "at the origin, as far as the points tell"
