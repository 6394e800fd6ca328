"""Curves of real scans, of simulated ones, and of scans whose rays are dropped independently: scores → PNG."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec, SubplotSpec
from matplotlib.ticker import NullFormatter, ScalarFormatter

from lidargrit.core.errors import ConfigError
from lidargrit.evaluation.realism import CurveScore
from lidargrit.viewer._matplotlib import write_png

_WIDTH, _ROW, _HEAD = 14.0, 3.4, 0.6  # inches: the picture, a row of panels, the title
_SIDES = {
    "real": "#26323c",
    "simulated": "#d1495b",
    "Bernoulli": "#2a8fbd",
}  # dark, warm, cold: told apart when printed grey
_MAPS = ("bev_occupancy",)  # metrics whose curves are views from above: both axes are metres
_TICKS_M = (1, 2, 5, 10, 20, 50, 100)


def plot_curves(scores: Sequence[CurveScore], path: Path, title: str = "") -> None:
    """Plot the curves of real scans, of simulated ones, and of independent drops: a panel for each score.

    Curves with two axes, such as a histogram for every row, get one image for each of the three, and the mean over
    rows where rows are of one kind. Scores without a curve are left out.
    """
    scores = [score for score in scores if "axis" in score.own.details]
    if not scores:
        raise ConfigError("no curve", "at least one", "compare some scans first")
    flat = [score for score in scores if _curve(score, "real").ndim == 1]
    deep = [score for score in scores if _curve(score, "real").ndim == 2]
    rows = -(-len(flat) // 2) + len(deep)
    height = _HEAD + _ROW * rows
    figure = Figure(figsize=(_WIDTH, height))
    grid = GridSpec(
        rows, 2, figure, left=0.06, right=0.98, top=1 - (_HEAD + 0.35) / height, bottom=0.55 / height,
        hspace=0.6, wspace=0.16,
    )  # fmt: skip
    figure.text(0.5, 1 - 0.3 / height, title, ha="center", va="center", fontsize=15, parse_math=False)
    for index, score in enumerate(flat):
        _plot_lines(figure.add_subplot(grid[index // 2, index % 2]), score)
    for index, score in enumerate(deep):
        _plot_images(figure, grid[rows - len(deep) + index, :], score)
    write_png(figure, path)


def _curve(score: CurveScore, which: str) -> Float64[np.ndarray, "*rows n"]:
    result = score.bernoulli if which == "Bernoulli" else score.own
    return np.array(result.details["real" if which == "real" else "generated"], dtype=float)


def _title(score: CurveScore) -> str:
    name = score.own.metric.replace("_", " ")
    distances = f"simulated {score.own.value:.3f}, Bernoulli {score.bernoulli.value:.3f}"
    return f"{name}\ndistance of real from {distances}, real {score.real_against_real.value:.3f}"


def _plot_lines(axes: Axes, score: CurveScore) -> None:
    details = score.own.details
    axis, label = np.array(details["axis"], dtype=float), details["axis_label"]
    lags = axis[0] < 0  # rows and columns share the axis: no line of numbers
    for which, colour in _SIDES.items():
        position = np.arange(len(axis)) if lags else axis
        axes.plot(position, _curve(score, which), color=colour, label=which, marker=".", markersize=4, linewidth=1.2)
    axes.set_title(_title(score), loc="left", fontsize=10)
    axes.set(xlabel=label, ylabel=details["curve_label"])
    if lags:
        axes.set_xticks(np.arange(len(axis)), [f"{-lag:g} rows" if lag < 0 else f"{lag:g}" for lag in axis])
    elif label.endswith("[m]"):
        _log_axis(axes)
    elif label.endswith("[pixels]"):
        dropped = any((_curve(score, which) > 0).any() for which in _SIDES)
        axes.set(xscale="log", yscale="log" if dropped else "linear")  # long runs are rare
    axes.grid(alpha=0.3, linewidth=0.5)
    axes.legend(fontsize=9)


def _log_axis(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_xticks([t for t in _TICKS_M if axes.get_xlim()[0] <= t <= axes.get_xlim()[1]])
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter(NullFormatter())


def _plot_images(figure: Figure, cell: SubplotSpec, score: CurveScore) -> None:
    """Plot the three images on one scale, with the mean over rows beside them where rows share an axis."""
    details = score.own.details
    axis = np.array(details["axis"], dtype=float)
    images = {which: _curve(score, which) for which in _SIDES}
    is_map = score.own.metric in _MAPS
    grid = cell.subgridspec(1, 4, wspace=0.25)
    norm = PowerNorm(0.5, 0, np.nanmax([np.nanmax(image, initial=0) for image in images.values()]) or 1)
    for index, (which, image) in enumerate(images.items()):
        axes = figure.add_subplot(grid[0, index])
        if is_map:
            half = axis[-1] + 0.5
            axes.imshow(image[::-1, ::-1], norm=norm, cmap="magma", extent=(half, -half, -half, half))
            axes.set(xlabel="left [m]", ylabel="forward [m]" if index == 0 else "")
        else:
            axes.pcolormesh(axis, np.arange(len(image)), np.nan_to_num(image), norm=norm, cmap="magma")
            axes.set(xlabel=details["axis_label"], ylim=(len(image) - 0.5, -0.5), ylabel="row" if index == 0 else "")
            _log_axis(axes)
        axes.set_title(which, loc="left", fontsize=10)
    box = cell.get_position(figure)
    figure.text(box.x0, box.y1 + 0.35 / figure.get_figheight(), _title(score), fontsize=10)
    axes = figure.add_subplot(grid[0, 3])
    for which, colour in _SIDES.items():
        values = np.sort(images[which].ravel())[::-1] if is_map else _mean_over_rows(images[which])
        axes.plot(np.arange(1, len(values) + 1) if is_map else axis, values, color=colour, label=which, linewidth=1.2)
    if is_map:
        axes.set(xscale="log", xlabel="rank of the cell")
        axes.set_title("cells, the fullest first", loc="left", fontsize=10)
    else:
        _log_axis(axes)
        axes.set_xlabel(details["axis_label"])
        axes.set_title("mean over rows", loc="left", fontsize=10)
    axes.grid(alpha=0.3, linewidth=0.5)
    axes.legend(fontsize=9)


def _mean_over_rows(image: Float64[np.ndarray, "rows n"]) -> Float64[np.ndarray, "n"]:
    """Return the mean of what is known of the rows; NaN, a gap in the line, where that is nothing."""
    known = np.isfinite(image)
    count = known.sum(axis=0)
    return np.where(count > 0, np.where(known, image, 0).sum(axis=0) / count.clip(1), np.nan)
