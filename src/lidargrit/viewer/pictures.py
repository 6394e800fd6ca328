"""Range images side by side as a picture: groups of range images → one PNG."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from torch import Tensor

from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import ConfigError
from lidargrit.data.images import RangeImages
from lidargrit.generation.generator import Generator
from lidargrit.scans.condition import Nothing
from lidargrit.scans.projection import points_of_pixels
from lidargrit.scans.types import RangeImage
from lidargrit.viewer._matplotlib import write_png
from lidargrit.viewer.report_pictures import NO_RETURN
from lidargrit.viewer.scan_sets import ANOMALOUS_BITS

SCANS_AT_MOST = 8  # scans of a group; more make a picture that no viewer shows well
_WIDTH, _ROW, _HEAD, _FOOT = 14.0, 2.95, 0.75, 0.95  # inches: the picture, one scan of one group, title, colour bars
_TICKS_AT_LEAST, _TICKS_AT_MOST = 3, 6  # of elevation: enough to read a row's by, and words that do not overlap
_FILLED, _FILLED_NOTE = "#e8730c", "\norange = filled in by a model"
_ANOMALY_NOTE = f"\nanomaly: black = as expected or less,\nyellow = {ANOMALOUS_BITS:g} bits more or beyond"
_SCANS = 2  # a glance; more would take training's time


def plot_comparison(
    groups: dict[str, RangeImage],
    path: Path,
    title: str = "",
    anomaly: dict[str, Float[Tensor, "B H W"]] | None = None,
    filled: dict[str, Bool[Tensor, "B H W"]] | None = None,
) -> None:
    """Plot groups of range images below one another: range, return mask and bird's-eye view of every scan.

    All groups share one scale of range, one of height, and the limits of the bird's-eye view. The i-th scans of all
    groups stand together.

    Args:
        groups: range images by name ("real", "reconstructed", ...), each one or a batch of 1 to 8; sensors may differ.
        anomaly: bits of every pixel beyond the expected ones, by group, plotted in place of the return mask; see
            :meth:`lidargrit.scans.bits.ScanBits.anomaly`.
        filled: True for pixels whose point a model filled in, by group; they have another colour in the return mask and
            in the bird's-eye view.
    """
    _check(groups)
    rows = [(index, name) for index in range(max(map(len, groups.values()))) for name in groups]
    panels = [
        _panel(groups[name], index, name, (anomaly or {}).get(name), (filled or {}).get(name))
        for index, name in rows
        if index < len(groups[name])
    ]
    scales = _Scales.of(panels)
    height = _HEAD * bool(title) + _ROW * len(panels) + _FOOT
    figure = Figure(figsize=(_WIDTH, height))
    if title:
        figure.text(0.5, 1 - 0.42 / height, title, ha="center", va="center", fontsize=17, parse_math=False)
    for row, panel in enumerate(panels):
        _plot_row(figure, height, _FOOT + _ROW * (len(panels) - 1 - row), panel, scales)
    notes = (_ANOMALY_NOTE if anomaly is not None else "") + (_FILLED_NOTE if filled else "")
    _plot_scales(figure, height, scales, notes)
    write_png(figure, path)


@dataclass(frozen=True, eq=False)
class _Panel:
    title: str
    range_m: Float[np.ndarray, "H W"]
    return_mask: Bool[np.ndarray, "H W"]
    points_xyz_m: Float[np.ndarray, "n 3"]
    elevation_deg: Float[np.ndarray, " H"]
    anomaly: Float[np.ndarray, "H W"] | None = None
    filled: Bool[np.ndarray, "H W"] | None = None


@dataclass(frozen=True, eq=False)
class _Scales:
    range_norm: LogNorm
    height_norm: Normalize
    half_view_m: float
    # Yellow is near and violet far; near-white is left to the rays without a return.
    range_colours: ClassVar[Colormap] = colormaps["viridis_r"].with_extremes(bad=NO_RETURN)
    height_colours: ClassVar[Colormap] = colormaps["turbo"].with_extremes(bad=NO_RETURN)

    @classmethod
    def of(cls, panels: list[_Panel]) -> "_Scales":
        """Return scales that hold all but the outermost returns of all panels."""
        ranges = np.concatenate([panel.range_m[panel.return_mask] for panel in panels] + [np.array([1.0])])
        points = np.concatenate([panel.points_xyz_m for panel in panels] + [np.zeros((1, 3))])
        far = float(ranges.max())
        near = min(float(np.quantile(ranges, 0.005)), far / 2)
        away = np.hypot(points[:, 0], points[:, 1])
        low, high = np.quantile(points[:, 2], (0.01, 0.99))
        return cls(
            LogNorm(near, far),
            Normalize(float(low), float(max(high, low + 0.1))),
            max(float(np.quantile(away, 0.99)), 1.0),
        )


def _check(groups: dict[str, RangeImage]) -> None:
    if not groups:
        raise ConfigError("no group of range images", "one or more", "pass for instance {'real': images}")
    for name, images in groups.items():
        if not 1 <= len(images) <= SCANS_AT_MOST or images.range_m.ndim > 3:
            raise ConfigError(
                f"range images of shape {tuple(images.range_m.shape)} in the group {name!r}",
                f"one image (H, W), or a batch (B, H, W) of 1 to {SCANS_AT_MOST}",
                f"pass a part of them: images[:{SCANS_AT_MOST}]",
            )


def _panel(images: RangeImage, index: int, name: str, anomaly: Tensor | None, filled: Tensor | None) -> _Panel:
    image = (images[index] if images.range_m.ndim == 3 else images).to("cpu")
    return _Panel(
        f"scan {index + 1}: {name}",
        image.range_m.detach().numpy(),
        image.return_mask.numpy(),
        points_of_pixels(image).detach()[image.return_mask].numpy(),
        image.sensor.elevation_rad.double().mean(dim=1).rad2deg().numpy(),
        None if anomaly is None else anomaly[index].detach().cpu().numpy(),
        None if filled is None else filled[index].cpu().numpy(),
    )


def _plot_row(figure: Figure, height: float, bottom: float, panel: _Panel, scales: _Scales) -> None:
    """Plot the range image above the return mask, and the bird's-eye view to their right; positions in inches."""

    def axes(left: float, up: float, wide: float, tall: float) -> Axes:
        return figure.add_axes((left / _WIDTH, (bottom + up) / height, wide / _WIDTH, tall / height))

    # A revolution is 13 times as wide as the rows are high; rows are plotted about twice as tall, to be seen.
    # All rows are equally high, though few sensors have equal steps of elevation: so up the picture go row numbers.
    extent = (180.0, -180.0, len(panel.elevation_deg) - 0.5, -0.5)
    ranges = axes(0.75, 1.55, 9.9, 1.05)
    shown = np.ma.masked_where(~panel.return_mask, panel.range_m)
    colours, norm = scales.range_colours, scales.range_norm
    ranges.imshow(shown, cmap=colours, norm=norm, aspect="auto", interpolation="nearest", extent=extent)
    share = panel.return_mask.mean()
    title = f"{panel.title}  ({'x'.join(map(str, panel.range_m.shape))}, {share:.0%} of rays returned)"
    ranges.set_title(title, loc="left", fontsize=12, parse_math=False)
    ranges.set_xticks([])
    mask = axes(0.75, 0.45, 9.9, 1.05)
    shape = {"aspect": "auto", "interpolation": "nearest", "extent": extent}
    if panel.anomaly is None:
        kinds = panel.return_mask.astype(int) if panel.filled is None else panel.return_mask * (1 + panel.filled)
        mask.imshow(kinds, cmap=ListedColormap([NO_RETURN, "#26323c", _FILLED]), vmin=0, vmax=2, **shape)
    else:
        mask.imshow(panel.anomaly, cmap="inferno", vmin=0, vmax=ANOMALOUS_BITS, **shape)
    mask.set_xlabel("azimuth, counter-clockwise from forward", fontsize=10, labelpad=0)
    mask.set_xticks(np.arange(180, -181, -45), [f"{d}°" for d in range(180, -181, -45)], fontsize=9)
    for axis, name in ((ranges, "range"), (mask, "return mask" if panel.anomaly is None else "anomaly")):
        axis.set_yticks(*_elevation_ticks(panel.elevation_deg), fontsize=9)
        axis.set_ylabel(name, fontsize=10)
    view = axes(11.3, 0.45, 2.25, 2.25)
    x, y, z = panel.points_xyz_m.T
    order, size = np.argsort(z), min(2.5, 30_000 / max(len(z), 1))  # the highest on top, as seen from above
    norm, colours = scales.height_norm, scales.height_colours
    view.scatter(y[order], x[order], c=z[order], s=size, linewidths=0, norm=norm, cmap=colours)
    if panel.filled is not None:
        x, y, _ = panel.points_xyz_m[panel.filled[panel.return_mask]].T
        view.scatter(y, x, c=_FILLED, s=size, linewidths=0)
    view.plot(0, 0, marker="+", color="black", markersize=7)
    half = scales.half_view_m
    view.set(xlim=(half, -half), ylim=(-half, half), aspect="equal", facecolor="white")  # left is to the left
    view.tick_params(labelsize=9)
    view.set_ylabel("forward [m]", fontsize=10, labelpad=0)
    view.set_xlabel("left [m]", fontsize=10, labelpad=0)


def _elevation_ticks(elevation_deg: Float[np.ndarray, " H"]) -> tuple[list[float], list[str]]:
    """Return at which rows round elevations lie, between two rows where need be, and their labels."""
    from_below = elevation_deg[::-1], np.arange(len(elevation_deg))[::-1]
    low, high = float(elevation_deg.min()), float(elevation_deg.max())
    ticks: dict[float, int] = {}  # row → degrees
    for step in (10, 5, 2, 1):  # finer steps only where the sensor spans too few of the coarse ones
        if len(ticks) >= _TICKS_AT_LEAST:
            break
        inside = range(math.ceil(low / step) * step, math.floor(high / step) * step + 1, step)
        for degrees in sorted(inside, key=abs):
            row = float(np.interp(degrees, *from_below))
            if all(abs(row - other) * _TICKS_AT_MOST >= len(elevation_deg) for other in ticks):
                ticks[row] = degrees
    if not ticks:  # a single row, or a few within a degree
        return [0.0], [f"{elevation_deg[0]:.1f}°".replace("-", "−")]
    return list(ticks), [f"{degrees}°".replace("-", "−") for degrees in ticks.values()]


def _plot_scales(figure: Figure, height: float, scales: _Scales, more: str = "") -> None:
    """Plot the two colour bars along the bottom, and the meaning of light grey."""
    at = 0.55 / height, 0.14 / height
    bar = figure.add_axes((0.75 / _WIDTH, at[0], 6.6 / _WIDTH, at[1]))
    ticks = [t for t in (1, 2, 5, 10, 20, 50, 100) if scales.range_norm(t) >= 0 and scales.range_norm(t) <= 1]
    colour_bar = figure.colorbar(ScalarMappable(scales.range_norm, scales.range_colours), bar, orientation="horizontal")
    colour_bar.set_ticks(ticks, labels=[str(t) for t in ticks])
    colour_bar.minorticks_off()
    colour_bar.set_label("range [m]", fontsize=10, labelpad=1)
    note = "light grey = no return" + more
    figure.text(7.6 / _WIDTH, at[0] + at[1] / 2, note, fontsize=10, va="center")
    bar = figure.add_axes((11.3 / _WIDTH, at[0], 2.25 / _WIDTH, at[1]))
    colour_bar = figure.colorbar(
        ScalarMappable(scales.height_norm, scales.height_colours), bar, orientation="horizontal"
    )
    colour_bar.set_label("from above: height over the sensor [m]", fontsize=10, labelpad=1)


@torch.no_grad()
def plot_progress(generator: Generator, stage: str, val: RangeImages, path: Path) -> None:
    """Plot validation scans, their reconstructions, and new scans once more than a tokenizer is in training."""
    real = val.batch(evenly_spaced(_SCANS, len(val)))
    groups = {"val": real}
    if "encode" in generator.capabilities:
        groups["reconstructed"] = generator.reconstruct(real).to("cpu")
    samples = stage != generator.stages[0] or len(generator.stages) == 1
    if samples and Nothing in generator.takes:
        groups["generated"] = generator.sample(range(_SCANS)).to("cpu")
    plot_comparison(groups, path, title=f"{stage}, {path.stem} scans seen")
