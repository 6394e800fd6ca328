"""Scans to turn, zoom and step through: range images → one HTML page that needs no network and no other file.

The page holds ranges in 16 bits and the rays of each sensor once; the browser computes the points from them. Points of
a cloud that have no pixel in its image follow with their coordinates. Scripts and style sheet are the files in
``browser/``.
"""

import base64
import gzip
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from markupsafe import Markup
from matplotlib import colormaps
from torch import Tensor

from lidargrit.core.errors import ConfigError
from lidargrit.core.files import write_text
from lidargrit.core.version import __version__
from lidargrit.scans.classes import CLASS_BITS, names_and_colours
from lidargrit.scans.projection import points_of_pixels
from lidargrit.scans.types import Scan
from lidargrit.viewer._page import asset, document, part
from lidargrit.viewer.scan_sets import ANOMALOUS_BITS, ScanSet

SOURCES_AT_MOST = 8  # browsers keep 8 to 16 WebGL canvases alive
_SCRIPTS = ("scans.js", "camera.js", "points.js", "files.js", "pane.js", "page.js")  # of every page that shows scans
_RANGE_STEPS = 65_535  # 16 bits, of which 0 is no return
_CLASSES_AT_MOST = 255  # 8 bits; SemanticKITTI has 34
_RAMP_STEPS = 64
_MOST = 0.85  # of the returns lie in what the first view shows
# Which part of which scale: ends that would vanish into the background are left out.
_RAMPS = {
    "dark": {
        "range": ("viridis_r", 0.0, 0.85),
        "height": ("plasma", 0.12, 1.0),
        "reflectance": ("inferno", 0.25, 1.0),
        "anomaly": ("inferno", 0.25, 1.0),
        "ring": ("turbo", 0.1, 0.95),
    },
    "light": {
        "range": ("viridis_r", 0.12, 1.0),
        "height": ("plasma", 0.0, 0.88),
        "reflectance": ("inferno_r", 0.18, 1.0),
        "anomaly": ("inferno_r", 0.18, 1.0),
        "ring": ("turbo", 0.03, 0.95),
    },
}
_NO_RETURN = {"dark": (72, 81, 90), "light": (214, 220, 225)}
_MEASURED = {"dark": (190, 198, 206), "light": (96, 106, 115)}
_FILLED = {"dark": (255, 150, 40), "light": (214, 96, 0)}
_UNKNOWN = {"dark": (140, 150, 160), "light": (110, 120, 130)}


def write_page(sets: Sequence[ScanSet], path: Path) -> None:
    """Write a page that shows sets of scans side by side, with one scale for each colour.

    Args:
        sets: 1 to 8 sets of scans; the i-th scans of all sets are shown together.
    """
    write_text(path, page(sets))


def page(sets: Sequence[ScanSet]) -> str:
    """Return the page as text; names of files and other foreign text are escaped."""
    if not 1 <= len(sets) <= SOURCES_AT_MOST:
        raise ConfigError(
            f"{len(sets)} sets of scans side by side", f"1 to {SOURCES_AT_MOST}", "name fewer, or make two pages"
        )
    coarsest_m = max(_far_m(scans) for scans in sets) / _RANGE_STEPS
    precision = f"Ranges are kept here in steps of {1000 * coarsest_m:.1f} mm. Written by lidargrit {__version__}."
    title = f"Scans: {', '.join(scans.name for scans in sets)}"
    content = viewer_html({"bin": "Save .bin", "ply": "Save .ply"}, precision, heading="Scans")
    return document(title, asset("page.css"), content, opening_script(), as_json(sets), "data: blob:")


def scripts() -> str:
    """Return the scripts of every page that shows scans; ``new Page`` starts them."""
    return '"use strict";\n' + "\n".join(asset(name) for name in _SCRIPTS) + "\n"


def opening_script() -> str:
    """Return the script of a page that holds its scans itself, as JSON in the element ``scans``."""
    return scripts() + asset("open.js")


def as_json(sets: Sequence[ScanSet]) -> str:
    """Return sets of scans as JSON for an element of a page; no name in them can end that element."""
    return json.dumps(page_data(sets)).replace("<", "\\u003c")


def viewer_html(buttons: Mapping[str, str], note: str, label: str = "", heading: str = "") -> Markup:
    """Return the elements that the scripts use: controls, a legend, room for scans, and instructions.

    Args:
        buttons: words of the buttons of each set of scans, by their names in the scripts.
        note: last sentence of the instructions.
        label: word before the buttons.
        heading: heading before the controls.
    """
    return part("viewer.html", buttons=buttons.items(), note=note, label=label, heading=heading)


def page_data(sets: Sequence[ScanSet]) -> dict[str, Any]:
    """Return all that a page needs to show sets of scans, as JSON values."""
    return {
        "sources": [_source(one) for one in sets],
        "scales": _scales(sets),
        "reachM": _reach_m(sets),
        "looks": {
            theme: {
                "ramps": {mode: _ramp(*of) for mode, of in ramps.items()},
                "noReturn": _NO_RETURN[theme],
                "unknown": _UNKNOWN[theme],
                "measured": _MEASURED[theme],
                "filled": _FILLED[theme],
            }
            for theme, ramps in _RAMPS.items()
        },
    }


def _source(scan_set: ScanSet) -> dict[str, Any]:
    """Return one set: its rays and its classes once, and the points of every scan: pixels, then those without one."""
    images = scan_set.images.to("cpu")
    step_m = _far_m(scan_set) / _RANGE_STEPS
    numbers = _numbers_of_classes(scan_set)
    named = names_and_colours(numbers)
    scans: list[dict[str, Any]] = []
    for index, name in enumerate(scan_set.scan_names):
        image, beside = images[index], scan_set.beside[index] if scan_set.beside else None
        hidden = scan_set.hidden[index] if scan_set.hidden else 0
        steps = (image.range_m.detach() / step_m).round().clamp(1, _RANGE_STEPS) * image.return_mask
        scan = {"name": name, "range": _packed(steps.numpy().astype("<u2")), "hidden": hidden}
        if scan_set.times_s:
            scan["time"] = round(scan_set.times_s[index] - scan_set.times_s[0], 3)
        if beside is not None:
            scan["beside"] = _packed(beside.points_xyz_m.numpy().astype("<f4"))
        if scan_set.anomaly is not None:
            share = (scan_set.anomaly[index] / ANOMALOUS_BITS).clamp(0, 1)
            scan["anomaly"] = _packed((255 * share).round().numpy().astype(np.uint8))
        if image.reflectance is not None:
            of_all = _followed_by(image.reflectance.detach(), beside, "reflectance")
            scan["reflectance"] = _packed((255 * of_all).round().astype(np.uint8))
        if scan_set.filled is not None:
            of_all = _followed_by(scan_set.filled[index], beside, "filled")
            scan["filled"] = _packed(of_all.astype(np.uint8))
        if image.label is not None:
            of_all = _followed_by(image.label, beside, "label") & CLASS_BITS
            scan["label"] = _packed(np.searchsorted(numbers, of_all).astype(np.uint8))
        scans.append(scan)
    return {
        "name": scan_set.name,
        "generated": scan_set.generated,
        "height": images.sensor.height,
        "width": images.sensor.width,
        "elevation": _packed(images.sensor.elevation_rad.numpy().astype("<f4")),
        "azimuth": _packed(images.sensor.azimuth_rad.numpy().astype("<f4")),
        "rangeStepM": step_m,
        "columnStride": images.sensor.column_stride,
        "endM": min(images.sensor.range_max_m, _far_m(scan_set)),  # a ray ends where returns do: the rest is empty
        "classes": [{"number": number, "name": name, "colour": colour} for number, name, colour in named],
        "scans": scans,
    }


def _followed_by(pixels: Tensor, beside: Scan | None, part: Literal["reflectance", "filled", "label"]) -> np.ndarray:
    """Return the values of all pixels, then those of the points without one; 0 where these have none."""
    values = pixels.numpy().ravel()
    if beside is None:
        return values
    known = {"reflectance": beside.reflectance, "filled": beside.filled, "label": beside.label}[part]
    more = np.zeros(len(beside)) if known is None else known.numpy()
    return np.concatenate([values, more.astype(values.dtype)])


def _numbers_of_classes(scan_set: ScanSet) -> list[int]:
    label = scan_set.images.label
    if label is None:
        return []
    found = [label[scan_set.images.return_mask].cpu().long()]
    found += [one.label.long() & CLASS_BITS for one in scan_set.beside if one and one.label is not None]
    numbers = torch.cat(found).unique().tolist()
    if len(numbers) > _CLASSES_AT_MOST:
        raise ConfigError(f"{len(numbers)} classes of labels", f"at most {_CLASSES_AT_MOST}", "show fewer scans")
    return numbers


def _far_m(scan_set: ScanSet) -> float:
    return max(float(scan_set.images.range_m.max()), 1.0)


def _packed(values: np.ndarray) -> str:
    return base64.b64encode(gzip.compress(values.tobytes(), mtime=0)).decode()


def _scales(sets: Sequence[ScanSet]) -> dict[str, tuple[float, float]]:
    """Return the two ends of each colour scale, which hold all but the outermost returns of all sets."""
    ranges = np.concatenate([one.images.range_m[one.images.return_mask].detach().cpu().numpy() for one in sets])
    heights = np.concatenate(
        [points_of_pixels(one.images)[one.images.return_mask][:, 2].detach().cpu().numpy() for one in sets]
    )
    if not len(ranges):
        ranges, heights = np.array([1.0, 10.0]), np.array([-2.0, 2.0])
    near, far = (float(value) for value in np.quantile(ranges, (0.005, 0.999)))
    low, high = (float(value) for value in np.quantile(heights, (0.01, 0.99)))
    return {
        "range": (near, max(far, 1.01 * near)),
        "height": (low, max(high, low + 0.1)),
        "reflectance": (0.0, 1.0),
        "anomaly": (0.0, ANOMALOUS_BITS),
        "ring": (0.0, 1.0),
    }


def _reach_m(sets: Sequence[ScanSet]) -> float:
    """Return the range within which most returns of all sets lie: what the first view has to show."""
    ranges = np.concatenate([one.images.range_m[one.images.return_mask].detach().cpu().numpy() for one in sets])
    return round(float(np.quantile(ranges, _MOST)), 1) if len(ranges) else 24.0


def _ramp(name: str, start: float, end: float) -> list[list[int]]:
    """Return red, green and blue of equal steps along a part of a scale."""
    colours = colormaps[name](np.linspace(start, end, _RAMP_STEPS))[:, :3]
    return (255 * colours).round().astype(int).tolist()
