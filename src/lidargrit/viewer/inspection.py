"""Losses and errors of a projection as a picture: :class:`Inspection` → PNG."""

from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap, LogNorm
from matplotlib.figure import Figure

from lidargrit.scans.projection.inspection import FATES, Inspection
from lidargrit.scans.projection.pixel_coordinates import row_elevation_rad
from lidargrit.scans.projection.sensor_check import elevations_deg
from lidargrit.viewer._matplotlib import write_png
from lidargrit.viewer.report_pictures import NO_RETURN

_COLOURS = {
    "above": "#7b3294",
    "below": "#e66101",
    "nearer": "#000000",
    "farther": "#2c7bb6",
    "left_out": "#c9c9c9",
    "hidden": "#d7191c",
    "kept": "#1a9641",
}
_DOT = 2.0  # area of a point in a view, the same for all: larger ones would make losses look more than they are
_DOTS_AT_MOST = 20_000  # of one kind in a view; more hide one another and take seconds to plot


def plot_inspection(inspection: Inspection, path: Path) -> None:
    """Plot which points collide, which are lost, and their elevations beside the sensor's rows."""
    figure = Figure(figsize=(14, 11), layout="constrained")
    panels = figure.subplot_mosaic(
        [["range"] * 3, ["collisions"] * 3, ["above", "side", "rows"]], height_ratios=[1, 1, 2.4]
    )
    sensor = inspection.sensor
    figure.suptitle(
        f"{Path(inspection.scan.source).name}: {inspection.method}, {inspection.variant}, to "
        f"{sensor.height}x{sensor.width} of {sensor.name}",
        parse_math=False,
    )
    _plot_range(figure, panels["range"], inspection)
    _plot_collisions(figure, panels["collisions"], inspection)
    _plot_lost(panels["above"], panels["side"], inspection)
    _plot_rows(panels["rows"], inspection)
    write_png(figure, path)


def _plot_range(figure: Figure, axes: Axes, inspection: Inspection) -> None:
    shown = np.ma.masked_where(~inspection.filled(), inspection.range_m)
    colours = colormaps["viridis_r"].with_extremes(bad=NO_RETURN)
    norm = LogNorm(inspection.sensor.range_min_m, inspection.sensor.range_max_m)
    plotted = axes.imshow(shown, cmap=colours, norm=norm, aspect="auto", interpolation="nearest")
    figure.colorbar(plotted, ax=axes, label="range [m]", pad=0.01)
    axes.set_title(f"range image, {inspection.filled().mean():.1%} of the pixels filled", loc="left")
    axes.set_ylabel("row")


def _plot_collisions(figure: Figure, axes: Axes, inspection: Inspection) -> None:
    # 0 grey, 1 white, and from 2 on ever darker red.
    colours = ListedColormap([NO_RETURN, "white", "#fcae91", "#fb6a4a", "#cb181d", "#67000d"])
    norm = BoundaryNorm([0, 1, 2, 3, 4, 6, 1000], colours.N)
    plotted = axes.imshow(inspection.points_per_pixel, cmap=colours, norm=norm, aspect="auto", interpolation="nearest")
    bar = figure.colorbar(plotted, ax=axes, label="points", pad=0.01)
    bar.set_ticks([0.5, 1.5, 2.5, 3.5, 5, 500], labels=["0", "1", "2", "3", "4, 5", "6 ..."])
    hidden = inspection.counts()["hidden"]
    axes.set_title(f"points per pixel; {hidden} hidden behind a nearer point of the same pixel", loc="left")
    axes.set(ylabel="row", xlabel="column: straight behind, left, ahead (in the middle), right, and behind again")


def _plot_lost(above: Axes, side: Axes, inspection: Inspection) -> None:
    """Plot every point from above and from the side, the lost ones in the colour of their fate."""
    x, y, z = inspection.scan.points_xyz_m.double().numpy().T  # in 32 bits, squares of huge numbers overflow
    away = np.hypot(x, y)
    names = list(FATES)
    # Those left out with their columns first, then the kept ones, so that they hide no lost one.
    for name in sorted(names, key=lambda name: (name != "left_out", name != "kept")):
        those = np.flatnonzero(inspection.fate == names.index(name))
        if len(those):
            shown = those[:: -(-len(those) // _DOTS_AT_MOST)]
            faint = {"color": _COLOURS[name], "linewidths": 0, "alpha": 0.25 if name == "left_out" else 0.8}
            above.scatter(y[shown], x[shown], s=_DOT, **faint)
            side.scatter(away[shown], z[shown], s=_DOT, **faint)
            side.scatter([], [], color=_COLOURS[name], s=20, label=f"{FATES[name]}: {len(those)}")
    half = float(np.quantile(away, 0.99)) or 1.0  # of points straight above, an axis without a length is no picture
    low, high = np.quantile(z, (0.001, 0.999))
    above.plot(0, 0, marker="+", color="black")
    above.set(xlim=(half, -half), ylim=(-half, half), aspect="equal", xlabel="left [m]", ylabel="forward [m]")
    above.set_title("from above", loc="left")
    side.set(xlim=(0, half), ylim=(low - 0.5, high + 0.5), xlabel="horizontal distance [m]", ylabel="height [m]")
    side.set_title("from the side: height over horizontal distance", loc="left")
    side.legend(loc="upper right", fontsize=8)


def _plot_rows(axes: Axes, inspection: Inspection) -> None:
    """Plot how many points lie at each elevation, over lines where the sensor has its rows."""
    rows_deg = np.degrees(row_elevation_rad(inspection.sensor))
    points_deg = elevations_deg(inspection.scan.points_xyz_m)
    low, high = np.quantile(points_deg, (0.001, 0.999))
    low, high = min(float(low), rows_deg[-1]) - 1, max(float(high), rows_deg[0]) + 1
    axes.hlines(rows_deg, 0, 1, transform=axes.get_yaxis_transform(), color="#1a9641", linewidth=0.5)
    # Ten bins of a degree show rings apart, of which the densest sensors have four in a degree.
    axes.hist(points_deg, bins=np.arange(low, high, 0.1).tolist(), orientation="horizontal", color="#26323c")
    axes.set(ylim=(low, high), xlabel="points in a tenth of a degree", ylabel="elevation [°]")
    axes.set_title("points (dark) and the sensor's rows (lines)", loc="left")
