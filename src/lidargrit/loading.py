"""Data sources → batches of range images: projected once, cached on disk, drawn and augmented by seed."""

from __future__ import annotations

import hashlib
import json
import os
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import torch

from lidargrit import __version__
from lidargrit.augmentation import Augmentation, augment
from lidargrit.datasets import BadPoints, ScanDataset, open_dataset
from lidargrit.errors import ConfigError, DataError, ScanError
from lidargrit.files import atomic_path, read_json, write_json
from lidargrit.projection import Variant, project
from lidargrit.reporting import Reporter
from lidargrit.sensors import SensorModel, load_sensor
from lidargrit.structures import RangeImage

_CACHE_FORMAT = 1  # to be raised whenever projection or simulation give other pixels for the same scan


@dataclass(frozen=True)
class DataConfig:
    """Which scans, and how they become range images.

    Args:
        train: sources to learn from, each "NAME:ROOT:SPLIT", "FOLDER" or "simulated:COUNT".
        val: sources to watch, never learned from.
        sensor: name of a sensor, or a sensor's ``.json`` file.
        columns: fine columns of the circle; 0 for the sensor's own.
        column_stride: keep every n-th of them.
        projection: ``sensor`` for the sensor's own, ``spherical`` or ``unfolding``.
        variant: ``exact``, or ``reference`` to repeat the released program's projection.
        max_scans: of each source, evenly spaced over it; 0 for all.
        bad_points: ``refuse`` scans with NaN, infinite or origin points, or ``drop`` these points.
        bad_scans: ``refuse`` to go on after a scan that cannot be used, or ``skip`` it and say so.
    """

    train: tuple[str, ...] = ()
    val: tuple[str, ...] = ()
    sensor: str = "hdl64e_kitti_odometry"
    columns: int = 0
    column_stride: int = 1
    projection: Literal["sensor", "spherical", "unfolding"] = "sensor"
    variant: Variant = "exact"
    max_scans: int = 0
    bad_points: BadPoints = "refuse"
    bad_scans: Literal["refuse", "skip"] = "refuse"

    def __post_init__(self) -> None:
        if self.max_scans < 0:
            raise ConfigError(f"max_scans={self.max_scans}", "at least 1, or 0 for all", "raise it")

    def load_sensor(self) -> SensorModel:
        """Return the sensor at the wanted number of columns and with the wanted projection."""
        sensor = load_sensor(self.sensor)
        if self.columns:
            sensor = sensor.with_columns(self.columns, self.column_stride)
        return sensor if self.projection == "sensor" else replace(sensor, projection=self.projection)


@runtime_checkable
class ImageStore(Protocol):
    """What holds the ranges of many images: an array, or files that read like one."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> np.ndarray: ...


class RangeImages:
    """Range images on disk that read like a list; only those asked for are in memory.

    Args:
        sensor: of the images that are read.
        parts: images as wide as the sensor's, or with all the fine columns of which the sensor keeps some.
        names: of the images: the file of a scan, or what else identifies it.
    """

    def __init__(self, sensor: SensorModel, parts: Sequence[ImageStore], names: Sequence[str]) -> None:
        self.sensor, self.names = sensor, list(names)
        self._parts = [part for part in parts if len(part)]
        self._ends = list(accumulate(len(part) for part in self._parts))

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def batch(self, indices: Sequence[int], first_columns: Sequence[int] | None = None) -> RangeImage:
        """Return the images of these indices as one batch, each from its own first fine column on."""
        first_columns = first_columns or [0] * len(indices)
        pixels = [self._pixels(index, first) for index, first in zip(indices, first_columns, strict=True)]
        range_m = torch.from_numpy(np.stack(pixels))
        return RangeImage(range_m, range_m > 0, self.sensor)

    def _pixels(self, index: int, first_column: int) -> np.ndarray:
        part = bisect_right(self._ends, index)
        fine = self._parts[part][index - (self._ends[part - 1] if part else 0)]
        return fine[:, first_column :: fine.shape[1] // self.sensor.width]


class Batches:
    """Training batches as a function of the scans seen before, so that a stopped run goes on as if never stopped.

    Args:
        images: what to draw from; every scan once per epoch, in an order of the seed.
        batch_size: over all processes.
        augmentations: applied in turn.
        any_columns: of the fine columns keep others every time a scan is seen; see :class:`FitConfig`.
        seed: of order and augmentation.
        rank: this process, of
        world_size: this many; each takes its share of every batch.
    """

    def __init__(
        self,
        images: RangeImages,
        batch_size: int,
        augmentations: Sequence[Augmentation],
        any_columns: bool,
        seed: int,
        rank: int = 0,
        world_size: int = 1,
    ) -> None:
        if batch_size % world_size:
            raise ConfigError(
                f"batch_size={batch_size} on {world_size} processes",
                "a multiple of the processes",
                "change one of them",
            )
        self.images, self.batch_size, self.augmentations = images, batch_size, tuple(augmentations)
        self.any_columns, self.seed, self.rank, self.world_size = any_columns, seed, rank, world_size
        self._epoch, self._order = -1, torch.empty(0)

    def at(self, scans_seen: int) -> RangeImage:
        """Return this process's share of the batch that follows ``scans_seen`` scans."""
        share = self.batch_size // self.world_size
        first = scans_seen + self.rank * share
        rng = torch.Generator().manual_seed(seed_of(self.seed, 1, first))
        columns = torch.randint(self.images.sensor.column_stride, (share,), generator=rng).tolist()
        indices = [self._draw(position) for position in range(first, first + share)]
        images = self.images.batch(indices, columns if self.any_columns else None)
        return augment(images, self.augmentations, rng)

    def _draw(self, position: int) -> int:
        epoch, place = divmod(position, len(self.images))
        if epoch != self._epoch:
            rng = torch.Generator().manual_seed(seed_of(self.seed, 0, epoch))
            self._epoch, self._order = epoch, torch.randperm(len(self.images), generator=rng)
        return int(self._order[place])


def seed_of(*parts: int) -> int:
    """Mix whole numbers into one seed: near numbers give seeds that have nothing in common."""
    return int(np.random.SeedSequence(parts).generate_state(1, np.uint64)[0] >> np.uint64(1))


def spread(count: int, total: int) -> list[int]:
    """Return at most ``count`` of ``total`` indices, evenly spaced: neighbours in time are nearly the same scan."""
    count = min(count, total)
    return [index * total // count for index in range(count)]


def load_range_images(
    sources: Sequence[str], config: DataConfig, reporter: Reporter | None = None, sensor: SensorModel | None = None
) -> RangeImages:
    """Project every scan of the sources, or find them projected in the cache; ``sensor`` stands in for the config's.

    The cache is ``$LIDARGRIT_CACHE``, else ``lidargrit`` in the user's cache folder. It may be deleted at any time.

    Raises:
        DataError: no source, or a source without a scan.
        ScanError: a scan that cannot be used; ``bad_scans=skip`` leaves it out.
    """
    if not sources:
        raise DataError("no source of scans", "at least one", "name one with --set data.train=FOLDER")
    reporter, sensor = reporter or Reporter(), sensor or config.load_sensor()
    parts: list[np.ndarray] = []
    names: list[str] = []
    for source in sources:
        dataset = open_dataset(source, config.bad_points)
        if dataset.sensor != sensor.name and not config.sensor.endswith(".json"):
            reporter.message(f"WARNING: {source} was made by {dataset.sensor}, and is imaged as {sensor.name}")
        stem = cache_folder() / _digest(source, dataset, sensor, config)
        if (cached := _read_cache(stem)) is None:
            _project_all(source, dataset, sensor, config, stem, reporter)
            cached = _read_cache(stem)
        assert cached is not None, stem
        parts.append(cached[0])
        names += cached[1]
    images = RangeImages(sensor, parts, names)
    if not len(images):
        raise DataError(f"no usable scan in {', '.join(sources)}", "at least one", "see the messages above")
    return images


def _project_all(
    source: str, dataset: ScanDataset, sensor: SensorModel, config: DataConfig, stem: Path, reporter: Reporter
) -> None:
    kept: list[str] = []
    fine = sensor.fine()
    wanted = spread(config.max_scans or len(dataset), len(dataset))
    shape = (len(wanted), fine.height, fine.width)
    with atomic_path(stem.with_suffix(".npy")) as temporary:
        pixels = np.lib.format.open_memmap(temporary, mode="w+", dtype=np.float32, shape=shape)
        if hasattr(os, "posix_fallocate"):  # a full disk is an OSError here; while pixels are set it is a bus error
            with temporary.open("r+b") as file:
                os.posix_fallocate(file.fileno(), 0, temporary.stat().st_size)
        with reporter.progress("projecting scans", len(wanted)) as progress:
            for index in wanted:
                try:
                    image = project(dataset.scan(index), fine, variant=config.variant)
                except ScanError as error:
                    if config.bad_scans == "refuse":
                        leave_out = "leave such scans out by --set data.bad_scans=skip (train) or --bad-scans skip"
                        raise ScanError(error.got, error.wanted, f"{error.cure}, or {leave_out}") from None
                    reporter.message(f"left out: {error}")
                else:
                    pixels[len(kept)] = image.range_m.numpy()
                    kept.append(str(dataset.paths[index].resolve()) if dataset.paths else dataset.name(index))
                progress.advance(1)
        pixels.flush()
    write_json(stem.with_suffix(".json"), {"source": source, "names": kept})  # written last: it says "complete"


def _read_cache(stem: Path) -> tuple[np.ndarray, list[str]] | None:
    """Return the images of a cache and their names; None if it is not there, not complete or damaged."""
    try:
        kept = read_json(stem.with_suffix(".json"))["names"]
        return np.load(stem.with_suffix(".npy"), mmap_mode="r", allow_pickle=False)[: len(kept)], kept
    except (OSError, ValueError, EOFError, KeyError, TypeError):  # ValueError: also what read_json raises
        return None


def cache_folder() -> Path:
    """Return where projected scans are kept."""
    if "LIDARGRIT_CACHE" in os.environ:
        return Path(os.environ["LIDARGRIT_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "lidargrit"


def _digest(source: str, dataset: ScanDataset, sensor: SensorModel, config: DataConfig) -> str:
    """Name a cache by everything that its pixels depend on."""
    try:
        files = [(str(path.resolve()), path.stat().st_size, path.stat().st_mtime_ns) for path in dataset.paths]
    except OSError as error:
        raise DataError(f"{error.filename}, which cannot be read", "files that are there", "remove the link") from None
    facts = [
        _CACHE_FORMAT,
        __version__,
        files or source,
        len(dataset),
        sensor.fine().to_json(),
        [config.variant, config.bad_points, config.bad_scans, config.max_scans],
    ]
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:24]
