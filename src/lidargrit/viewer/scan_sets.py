"""Sources of scans, and runs → sets of range images to look at."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from lidargrit.core import reporting
from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import ConfigError, DataError, no_usable_scan
from lidargrit.core.untrusted import seeds_in_a_row
from lidargrit.data.prepared.config import NOTHING_NAMED, DataConfig, ScanSettings
from lidargrit.data.sources import DatasetSource, RunSource, Source, open_source
from lidargrit.data.windows import TimedScan
from lidargrit.generation.generator import Generator, load
from lidargrit.nn.devices import usable_device
from lidargrit.scans.many_scans import leaving_out
from lidargrit.scans.projection import index_map, project
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage, Scan

_PIXELS_AT_MOST = 200_000  # of a scan on a page: what browsers still turn smoothly
_BESIDE_AT_MOST = 200_000  # points of a scan on a page that have no pixel: a map of many scans has millions
ANOMALOUS_BITS = 12.0  # beyond those expected: what happens to one pixel in some thousands
_NAME_LETTERS = 40  # of a source's name: what fits above a picture


@dataclass(frozen=True, eq=False)
class ScanSet:
    """A set of scans that are shown together, under one name.

    Args:
        name: name of the scans' source, or of what a model made of it.
        anomaly: bits of every pixel beyond those expected, see :meth:`lidargrit.scans.bits.ScanBits.anomaly`; None
            if no model was asked.
        filled: True for pixels whose point a model filled in; None where no scan says so.
        beside: points of each scan without a pixel in its image that are shown besides, None for none; empty if the
            scans are no clouds.
        hidden: number of points of each scan that are not shown; empty if all are.
        generated: whether a model generated all of it.
        times_s: time of each scan on the clock of its drive; empty if it is not known of all.
    """

    name: str
    images: RangeImage
    scan_names: tuple[str, ...]
    anomaly: Float[Tensor, "B H W"] | None = None
    filled: Bool[Tensor, "B H W"] | None = None
    beside: tuple[Scan | None, ...] = ()
    hidden: tuple[int, ...] = ()
    generated: bool = False
    times_s: tuple[float, ...] = ()


def load_scan_sets(
    sources: Sequence[str],
    count: int,
    seed: int = 0,
    settings: ScanSettings = NOTHING_NAMED,
    sensor: SensorModel | None = None,
    all_columns: bool = False,
    device: str = "",
) -> list[ScanSet]:
    """Read scans and samples, and sample from runs.

    Scans are projected to the sensor that is named, else that of the first run, else that of the first samples or
    prepared scans; where there is none of these, each set to its own. A run gives a set of generated scans and, if
    its generator has tokens and the first source of scans lies on its rays, a set of reconstructions of these.

    Args:
        sources: sources of scans, folders of samples, prepared folders, and folders of runs.
        count: number of scans of each set, evenly spaced over its source.
        seed: seed of the first generated scan.
        settings: sensor that scans are imaged with, and settings of reading them.
        sensor: sensor to project scans with if the settings name none; those of runs and samples keep theirs.
        all_columns: whether scans are shown with all columns that their sensor fires, up to 200,000 pixels; otherwise
            with those that its image keeps. Then points without a pixel are shown as well. It has no effect if the
            settings give a number of columns, beside samples and runs, nor with a ``sensor``.
    """
    config = settings.data
    opened = [open_source(source, config.bad_points) for source in sources]
    runs, chosen = [source for source in opened if isinstance(source, RunSource)], usable_device(device)
    seeds = seeds_in_a_row(seed, count) if runs else range(0)
    generators = {source.text: load(source.text).to(chosen) for source in runs}
    named = settings.load_sensor()
    scans_alone = sensor is None and all(isinstance(source, DatasetSource) for source in opened)
    fine = all_columns and scans_alone and not config.columns
    sensor = named or sensor or next((generator.sensor for generator in generators.values()), None)
    if sensor is None:
        imaged = (source for source in opened if not isinstance(source, (DatasetSource, RunSource)))
        sensor = next((source.sensor for source in imaged), None)
    sets: list[ScanSet] = []
    for source in opened:
        if not isinstance(source, RunSource):
            rays = _fine(named or config.with_projection(source.sensor)) if fine else sensor
            how = (count, rays, config)
            read = _of_scans(source, *how, fine) if isinstance(source, DatasetSource) else _of_images(source, *how)
            sets.append(replace(read, name=_short(source.text)))
    scans = sets[0] if sets else None
    for name, generator in generators.items():
        sets += _of_generator(name, generator, seeds, scans)
    if not sets:
        raise ConfigError("no source", "a scan, a folder or a run", "name at least one")
    return _told_apart(sets)


def _told_apart(sets: Sequence[ScanSet]) -> list[ScanSet]:
    """Return the sets with numbers behind names that several of them have: viewers find a set by its name."""
    names = [one.name for one in sets]
    return [
        replace(one, name=f"{one.name} ({names[: index + 1].count(one.name)})") if names.count(one.name) > 1 else one
        for index, one in enumerate(sets)
    ]


def _of_generator(name: str, generator: Generator, seeds: range, scans: ScanSet | None) -> Iterator[ScanSet]:
    """Yield the reconstructions of some scans, if there are any on its rays, and generated scans."""
    if scans is not None and "encode" in generator.capabilities:
        images = scans.images
        if generator.sensor.same_rays(images.sensor):
            reconstructed = generator.reconstruct(images).to("cpu")
            yield ScanSet(f"{_short(name)}: reconstructed", reconstructed, scans.scan_names, generated=True)
        else:
            reporting.message(f"{name}: no reconstructions, for its sensor has other rays than {scans.name}")
    generated = generator.sample(seeds).to("cpu")
    yield ScanSet(f"{_short(name)}: generated", generated, tuple(f"seed {one}" for one in seeds), generated=True)


def _fine(sensor: SensorModel) -> SensorModel:
    """Return a sensor with all columns that it fires, or as it is if these are too many pixels for a page."""
    fine = sensor.fine()
    return fine if fine.height * fine.width <= _PIXELS_AT_MOST else sensor


def _of_images(source: Source, count: int, sensor: SensorModel | None, config: DataConfig) -> ScanSet:
    images = source.images(sensor, source.as_projected(config))
    indices = evenly_spaced(count, len(images))
    names = tuple(images.provenance.names[index].rpartition("/")[2] for index in indices)
    timed = images.timed_scans()
    times_s = _times_s(timed[index] for index in indices)
    return ScanSet(source.text, images.batch(indices), names, generated=source.is_generated, times_s=times_s)


def _times_s(scans: Iterable[TimedScan]) -> tuple[float, ...]:
    every = [scan.motion.time_s for scan in scans]
    known = tuple(time_s for time_s in every if time_s is not None)
    return known if len(known) == len(every) else ()


def _of_scans(
    source: DatasetSource, count: int, sensor: SensorModel | None, config: DataConfig, shows_beside: bool
) -> ScanSet:
    dataset, imaging = source.scans(), source.imaging(sensor, config)
    imaging.report()
    sensor, config = imaging.sensor, imaging.config
    images, indices, filled, beside, hidden = [], [], [], [], []
    for index in evenly_spaced(count, len(dataset)):
        with leaving_out(config.bad_scans == "skip"):
            scan = dataset.scan(index)
            image = project(scan, sensor, variant=config.projection_variant)
            shown = index_map(scan, sensor, variant=config.projection_variant)[:, :: sensor.column_stride]
            has_pixel = torch.zeros(len(scan), dtype=torch.bool)
            has_pixel[torch.from_numpy(shown).long()[image.return_mask]] = True
            marked = None if scan.filled is None else _of_pixels(scan.filled, shown)
            without = (~has_pixel).nonzero()[:, 0]
            shown_too = without[evenly_spaced(_BESIDE_AT_MOST * shows_beside, len(without))]
            others = replace(scan, rows=None).select(shown_too) if len(shown_too) else None
            images.append(image)  # all lists or, if anything above refuses the scan, none
            indices.append(index)
            filled.append(marked)
            beside.append(others)
            hidden.append(len(without) - len(shown_too))
    if not images:
        raise no_usable_scan(source.text)
    marks = torch.stack([torch.zeros_like(images[0].return_mask) if one is None else one for one in filled])
    known = any(one is not None for one in filled)
    stacked, names = RangeImage.stack(images), tuple(map(dataset.name, indices))
    marks = marks if known else None
    try:
        times_s = _times_s(dataset.timed_scans(indices))
    except DataError as error:  # files beside the scans, which can be shown without
        reporting.message(f"times are not known: {error}")
        times_s = ()
    return ScanSet(source.text, stacked, names, None, marks, tuple(beside), tuple(hidden), times_s=times_s)


def _of_pixels(marks: Bool[Tensor, "n"], point: Int32[np.ndarray, "H W"]) -> Bool[Tensor, "H W"]:
    """Return the mark of each pixel's point; False where there is none, -1."""
    return torch.cat((marks, torch.zeros(1, dtype=torch.bool)))[torch.from_numpy(point).long()]


def _short(source: str) -> str:
    if len(source) < _NAME_LETTERS:
        return source
    end = source[3 - _NAME_LETTERS :]
    return f"...{end[max(end.rstrip('/').find('/'), 0) :]}"
