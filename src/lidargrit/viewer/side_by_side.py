"""Sets of scans side by side on one scale: sources → a PNG, or a page to turn and step through."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from lidargrit.core import reporting
from lidargrit.core.errors import ConfigError
from lidargrit.core.untrusted import PAGE_SCANS_AT_MOST
from lidargrit.data.prepared.config import NOTHING_NAMED, ScanSettings
from lidargrit.data.sources.scan_sensor import other_sensor
from lidargrit.generation.generator import load
from lidargrit.viewer.interactive import write_page
from lidargrit.viewer.pictures import SCANS_AT_MOST, plot_comparison
from lidargrit.viewer.scan_sets import ScanSet, load_scan_sets


def view(
    sources: Sequence[str],
    out: Path,
    count: int = 3,
    seed: int = 0,
    settings: ScanSettings = NOTHING_NAMED,
    anomaly_by: str = "",
    device: str = "",
) -> None:
    """Plot scans, samples, and the scans that runs generate and reconstruct; see also :func:`load_scan_sets`.

    Args:
        out: path of the PNG, or of the page if it ends in ``.html``.
        anomaly_by: folder of the run whose anomaly at every pixel is a colour of the page, or is plotted in place of
            the return mask; none if empty.
    """
    is_page = out.suffix.lower() == ".html"
    at_most = PAGE_SCANS_AT_MOST if is_page else SCANS_AT_MOST
    if not 1 <= count <= at_most:
        other = "" if is_page else f", or write an .html, which takes {PAGE_SCANS_AT_MOST}"
        raise ConfigError(f"{count} scans of each set", f"1 to {at_most}", f"correct the number{other}")
    model = load(anomaly_by, device=device) if anomaly_by else None
    rays = None if model is None else model.sensor
    sets = load_scan_sets(sources, count, seed, settings, rays, is_page, device)
    if model is not None:
        for scans in sets:
            if not scans.images.sensor.same_rays(model.sensor):
                raise other_sensor(scans.images.sensor, model.sensor, anomaly_by, settings.sensor)
        sets = [replace(scans, anomaly=model.bits(scans.images, expected=True).anomaly().cpu()) for scans in sets]
    for scans in sets:
        _tell_hidden(scans, is_page)
    groups = {scans.name: scans.images for scans in sets}
    if is_page:
        write_page(sets, out)
    else:
        anomaly = {scans.name: scans.anomaly for scans in sets if scans.anomaly is not None}
        filled = {scans.name: scans.filled for scans in sets if scans.filled is not None}
        plot_comparison(groups, out, anomaly=anomaly or None, filled=filled)


def _tell_hidden(scans: ScanSet, is_page: bool) -> None:
    """Say how many points of a set of clouds are not shown, and why."""
    beside = [len(scan) for scan in scans.beside if scan]
    hidden, shown = sum(scans.hidden), int(scans.images.return_mask.sum()) + sum(beside)
    if hidden:
        size = f"{scans.images.sensor.height}x{scans.images.sensor.width}"
        cure = "leave samples, runs, --color and data.columns out" if is_page else "write an .html"
        why = f"each pixel of {size} shows one; {cure} to see all"
        if beside:
            why = f"a page shows {max(beside):,} points beside the pixels of {size}"
        reporting.message(f"{scans.name}: {hidden:,} of {hidden + shown:,} points are hidden, since {why}")
