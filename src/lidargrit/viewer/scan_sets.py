"""Anything that holds scans → range images to look at, with the labels of their points where there are any."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Int
from torch import Tensor

from lidargrit.datasets import open_dataset
from lidargrit.determinism import evenly_spaced
from lidargrit.errors import ConfigError, DataError, ScanError
from lidargrit.generators import is_run, load, locate
from lidargrit.loading import DataConfig
from lidargrit.projection import index_map, project
from lidargrit.reporting import Reporter
from lidargrit.sensors import SensorModel, load_sensor
from lidargrit.sources import holds_images, open_images
from lidargrit.structures import RangeImage, Scan

_CLASS_BITS = 0xFFFF  # of a label; the instance stands above them
_BATCH = 8  # scans drawn at once: what a laptop has room for
_NAME_LETTERS = 40  # of a place: what fits above a picture


@dataclass(frozen=True, eq=False)
class ScanSet:
    """Some scans of one place.

    Args:
        name: of the place, and of what was made of it.
        images: a batch.
        scan_names: one for each image.
        label: class of every pixel by SemanticKITTI's numbers, 0 where it is not known or nothing returned.
    """

    name: str
    images: RangeImage
    scan_names: tuple[str, ...]
    label: Int[Tensor, "B H W"] | None = None


def load_scan_sets(
    places: Sequence[str],
    count: int,
    seed: int = 0,
    config: DataConfig | None = None,
    reporter: Reporter | None = None,
) -> list[ScanSet]:
    """Read scans and samples, and draw from runs; the sensor of the first run is everybody's.

    Args:
        places: each a run's folder (*generated*, and *reconstructed* from the first scans beside it if its generator
            can encode), a folder of samples, a prepared place, or a source of scans.
        count: scans of each, evenly spaced.
        seed: of the first generated scan.
        config: how scans are read and projected.
        reporter: hears of scans that are left out.
    """
    config, reporter = config or DataConfig(), reporter or Reporter()
    generators = {place: load(place) for place in places if is_run(locate(place))}
    sensor = next((generator.sensor for generator in generators.values()), None)
    shown: list[ScanSet] = []
    for place in places:
        if place not in generators:
            read = _of_images if holds_images(place) else _of_scans
            shown.append(replace(read(place, count, sensor, config, reporter), name=_short(place)))
    scans = shown[0] if shown else None
    for place, generator in generators.items():
        if scans is not None and "encode" in generator.capabilities:
            images = scans.images
            again = _joined(generator.reconstruct(images[part]) for part in _parts(len(images)))
            shown.append(ScanSet(f"{_short(place)}: reconstructed", again, scans.scan_names))
        seeds = range(seed, seed + count)
        names = tuple(f"seed {one}" for one in seeds)
        drawn = _joined(generator.sample(seeds[part]) for part in _parts(count))
        shown.append(ScanSet(f"{_short(place)}: generated", drawn, names))
    if not shown:
        raise ConfigError("nothing to draw", "a scan, a folder or a run", "name at least one")
    return shown


def _parts(count: int) -> list[slice]:
    return [slice(first, first + _BATCH) for first in range(0, count, _BATCH)]


def _joined(batches: Iterable[RangeImage]) -> RangeImage:
    return RangeImage.stack([batch[index].to("cpu") for batch in batches for index in range(len(batch))])


def _of_images(place: str, count: int, sensor: SensorModel | None, config: DataConfig, reporter: Reporter) -> ScanSet:
    images = open_images(place, sensor, config, reporter)
    indices = evenly_spaced(count, len(images))
    names = images.provenance.names
    return ScanSet(place, images.batch(indices), tuple(names[index].rpartition("/")[2] for index in indices))


def _of_scans(place: str, count: int, sensor: SensorModel | None, config: DataConfig, reporter: Reporter) -> ScanSet:
    dataset = open_dataset(place, config.bad_points)
    sensor = sensor or load_sensor(dataset.sensor)
    images, names, labels = [], [], []
    for index in evenly_spaced(count, len(dataset)):
        try:
            scan = dataset.scan(index)
            images.append(project(scan, sensor, variant=config.projection_variant))
        except ScanError as error:
            if config.bad_scans == "refuse":
                raise
            reporter.message(f"left out: {error}")
            continue
        names.append(dataset.name(index))
        labels.append(_label_of_pixels(scan, images[-1], config))
    if not images:
        raise DataError(f"no usable scan in {place}", "at least one", "see the messages above")
    known = [label for label in labels if label is not None]
    label = torch.stack(known) if len(known) == len(images) else None
    return ScanSet(place, RangeImage.stack(images), tuple(names), label)


def _label_of_pixels(scan: Scan, image: RangeImage, config: DataConfig) -> Int[Tensor, "H W"] | None:
    if scan.label is None:
        return None
    point_of_pixel = index_map(scan, image.sensor, variant=config.projection_variant)[:, :: image.sensor.column_stride]
    label = scan.label[torch.from_numpy(point_of_pixel).long().clamp(min=0)] & _CLASS_BITS
    return torch.where(image.return_mask, label, 0)


def _short(place: str) -> str:
    return place if len(place) < _NAME_LETTERS else "..." + place[3 - _NAME_LETTERS :]
