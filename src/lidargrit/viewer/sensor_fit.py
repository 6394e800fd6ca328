"""Evidence for and against a fitted sensor as a picture: :class:`SensorFit` → PNG."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lidargrit.scans.fit_sensor import SensorFit
from lidargrit.viewer._matplotlib import write_png

_POINT, _ROW, _BAD = "#3b6ea5", "#d95f02", "#b2182b"
_BINS_PER_ROW = 12  # of the histogram of elevations: enough to see a gap between rows, few enough to see peaks


def plot_sensor_fit(fit: SensorFit, path: Path) -> None:
    """Plot elevations with the fitted rows, the spread and number of points of each ring, and steps in azimuth."""
    figure = Figure(figsize=(14.0, 9.0), layout="constrained")
    sensor = fit.sensor
    figure.suptitle(
        f"{sensor.name}: {sensor.height} rows ({fit.method}), {sensor.width} columns, scans: {fit.num_scans}, "
        f"{fit.agree_share:.1%} of the points agree",
        parse_math=False,
    )
    tall, upper, lower, steps = figure.subplot_mosaic(
        [["tall", "upper"], ["tall", "lower"], ["tall", "steps"]]
    ).values()
    rows_deg = np.degrees(sensor.elevation_rad.double().numpy()[:, 0])
    _plot_elevations(tall, fit, rows_deg)
    _plot_spread(upper, fit, rows_deg)
    _plot_counts(lower, fit)
    _plot_steps(steps, fit)
    write_png(figure, path)


def _plot_elevations(axes: Axes, fit: SensorFit, rows_deg: np.ndarray) -> None:
    margin = max(1.0, 0.05 * float(np.ptp(rows_deg)))
    low, high = float(rows_deg.min()) - margin, float(rows_deg.max()) + margin
    width = float(np.ptp(rows_deg)) / min(2000, max(1, len(rows_deg) - 1) * _BINS_PER_ROW) or margin
    bins = np.arange(float(rows_deg.max()) + width / 2, low - width, -width)[::-1]  # equal rows in the middle of theirs
    bins = np.append(bins, np.arange(bins[-1] + width, high + width, width))
    seen = axes.get_yaxis_transform()
    axes.hlines(rows_deg, 0, 1, transform=seen, color=_ROW, linewidth=0.6, alpha=0.25, zorder=0)
    axes.hlines(rows_deg, 0.95, 1, transform=seen, color=_ROW, linewidth=0.8, label="fitted rows")
    axes.hist(
        fit.elevations_deg,
        bins=bins.tolist(),
        orientation="horizontal",
        histtype="stepfilled",  # bars thinner than a dot of the picture would vanish
        color=_POINT,
        edgecolor=_POINT,
        label="points",
    )
    axes.set(xlabel="points", ylabel="elevation, degrees", title="where points are seen", ylim=(low, high))
    axes.legend(loc="lower right")


def _plot_spread(axes: Axes, fit: SensorFit, rows_deg: np.ndarray) -> None:
    row = np.arange(len(rows_deg))
    gap = np.abs(np.diff(rows_deg))
    nearest = np.minimum(np.append(gap, np.inf), np.insert(gap, 0, np.inf))
    lowest = 1e-4  # degrees: single precision, and simulated scans, lie below this
    axes.semilogy(row, nearest, color="grey", linewidth=1, label="distance to the next row")
    blurred = fit.residual_deg > nearest / 2
    axes.semilogy(row, np.maximum(fit.residual_deg, lowest), "o", color=_POINT, markersize=3, label="spread of points")
    axes.semilogy(row[blurred], fit.residual_deg[blurred], "o", color=_BAD, markersize=4, label="too wide")
    axes.set(xlabel="row, 0 = the highest", ylabel="degrees", title="how sharp each ring is")
    axes.set_ylim(lowest / 2, 2 * float(max(nearest.max(), fit.residual_deg.max())))
    axes.legend(loc="best", ncols=3, fontsize="small")


def _plot_counts(axes: Axes, fit: SensorFit) -> None:
    axes.bar(np.arange(len(fit.points_per_ring)), fit.points_per_ring / fit.num_scans, width=0.8, color=_POINT)
    axes.axhline(fit.sensor.width, color=_ROW, linewidth=1, label="columns")
    axes.set(xlabel="row, 0 = the highest", ylabel="points a scan", title="how many points each ring has")
    axes.legend(loc="lower right")


def _plot_steps(axes: Axes, fit: SensorFit) -> None:
    step_deg = 360 / fit.sensor.width
    axes.hist(fit.steps_deg, bins=200, range=(0, 4.5 * step_deg), color=_POINT, log=True)
    for multiple in range(1, 5):
        axes.axvline(multiple * step_deg, color=_ROW, linewidth=1, label="whole columns" if multiple == 1 else None)
    axes.set(xlabel="step in azimuth, degrees", ylabel="pairs of points", title="from one point of a ring to the next")
    axes.legend(loc="upper right")
