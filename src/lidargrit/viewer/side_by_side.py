"""Anything that holds scans, side by side on one scale: places → a PNG, or a page to turn and step through."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lidargrit.errors import ConfigError
from lidargrit.loading import DataConfig
from lidargrit.reporting import Reporter
from lidargrit.viewer.interactive import PAGE_SCANS_AT_MOST, write_page
from lidargrit.viewer.pictures import SCANS_AT_MOST, plot_comparison
from lidargrit.viewer.scan_sets import load_scan_sets


def view(
    places: Sequence[str],
    out: Path,
    count: int = 3,
    seed: int = 0,
    config: DataConfig | None = None,
    reporter: Reporter | None = None,
) -> None:
    """Draw scans, samples and what a run makes of them.

    Args:
        places: each a run's folder (drawn as *generated*, and as *reconstructed* if there are scans beside it and
            its generator can encode), a
            folder of samples, or a source of scans.
        out: the PNG, or the page if it ends in ``.html``.
        count: scans of each, evenly spaced.
        seed: of the first generated scan.
        config: how scans are read and projected.
        reporter: hears of scans that are left out.
    """
    is_page = out.suffix.lower() == ".html"
    at_most = PAGE_SCANS_AT_MOST if is_page else SCANS_AT_MOST
    if not 1 <= count <= at_most:
        raise ConfigError(f"{count} scans of each to draw", f"1 to {at_most}", "correct the number")
    shown = load_scan_sets(places, count, seed, config, reporter)
    if is_page:
        write_page(shown, out)
    else:
        plot_comparison({one.name: one.images for one in shown}, out)
