"""Anything that holds scans, drawn side by side on one scale: paths → PNG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lidargrit.errors import ConfigError
from lidargrit.evaluation.score import open_images
from lidargrit.generators import is_run, load
from lidargrit.loading import DataConfig, spread
from lidargrit.sensors import SensorModel
from lidargrit.structures import RangeImage
from lidargrit.viewer.pictures import SCANS_AT_MOST, draw_comparison


def view(places: Sequence[str], picture: Path, count: int = 3, seed: int = 0, config: DataConfig | None = None) -> None:
    """Draw scans, samples and what a run makes of them.

    Args:
        places: each a run's folder (drawn as *generated*, and as *reconstructed* if there are scans beside it and
            its generator can encode), a
            folder of samples, or a source of scans.
        picture: the PNG.
        count: scans of each, evenly spaced.
        seed: of the first generated scan.
        config: how scans are read and projected.
    """
    if not 1 <= count <= SCANS_AT_MOST:
        raise ConfigError(f"{count} scans of each to draw", f"1 to {SCANS_AT_MOST}", "correct the number")
    runs = [place for place in places if is_run(Path(place))]
    generators = {place: load(place) for place in runs}
    sensor: SensorModel | None = next((generator.sensor for generator in generators.values()), None)
    groups: dict[str, RangeImage] = {}
    for place in places:
        if place not in runs:
            images = open_images(place, sensor, config)
            groups[_short(place)] = images.batch(spread(count, len(images)))
    scans = dict(groups)
    for place, generator in generators.items():
        if scans and "encode" in generator.capabilities:
            groups[f"{_short(place)}: reconstructed"] = generator.reconstruct(next(iter(scans.values())))
        groups[f"{_short(place)}: generated"] = generator.sample(range(seed, seed + count))
    if not groups:
        raise ConfigError("nothing to draw", "a scan, a folder or a run", "name at least one")
    draw_comparison(groups, picture)


def _short(place: str) -> str:
    return place if len(place) < 40 else "..." + place[-37:]
