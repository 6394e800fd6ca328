"""Range images on disk → batches in memory, of only the images that are asked for."""

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import accumulate, chain, pairwise
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32, Shaped

from lidargrit.core.errors import DataError, LidarGritError
from lidargrit.data.windows import TimedScan
from lidargrit.scans.motion import Motion
from lidargrit.scans.planes import PLANES
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage


class Pixels(NamedTuple):
    """The pixels of one image.

    Args:
        planes: further planes that are known, by names of :data:`~lidargrit.scans.planes.PLANES`.
    """

    range_m: Float32[np.ndarray, "H W"]
    planes: Mapping[str, Shaped[np.ndarray, "H W"]] = MappingProxyType({})


@dataclass(frozen=True)
class Provenance:
    """Where images come from; two provenances show which scans or drives two sets share.

    Args:
        names: one name for each image: the file of its scan, or another identifier.
        recordings: names of the drives that the images were cut from; empty for generated scans.
        fingerprints: one hash of the pixels for each image; empty where it is not known.
        range_fingerprints: one hash of the ranges for each image, without reflectance; empty where it is not known.
        label_fingerprints: one hash of the classes for each image, "" without any; empty where it is not known.
    """

    names: tuple[str, ...] = ()
    recordings: tuple[str, ...] = ()
    fingerprints: tuple[str, ...] = ()
    range_fingerprints: tuple[str, ...] = ()
    label_fingerprints: tuple[str, ...] = ()

    @property
    def streets(self) -> tuple[str, ...]:
        """Versions of the simulated streets among the recordings, such as "streets 2"; before there were several, 1."""
        parts = {tuple(each.split("/")) for each in self.recordings if each.startswith("simulated/")}
        return tuple(sorted({part[1] if len(part) > 2 else "streets 1" for part in parts}))

    @classmethod
    def joined(cls, parts: "Sequence[Provenance]") -> "Provenance":
        """Join the provenances of several sets, in their order."""
        return cls(*(tuple(chain.from_iterable(getattr(part, of.name) for part in parts)) for of in fields(cls)))

    def overlap(self, other: "Provenance") -> str:
        """Return in a few words what two sets share; "" if they share nothing that is known.

        Two scans are the same if their files, their pixels or their ranges are. Scans of one drive show the same
        streets; they are recognised by their recording, also where two data sets hold the same recording.
        """
        pairs = (
            (self.names, other.names),
            (self.fingerprints, other.fingerprints),
            (self.range_fingerprints, other.range_fingerprints),
        )
        scans = max(len((set(mine) & set(theirs)) - {""}) for mine, theirs in pairs)
        if scans:
            return f"{scans} {'scans are' if scans > 1 else 'scan is'} in both"
        drives = sorted(set(self.recordings) & set(other.recordings) - {""})
        if drives:
            return f"both have scans of {', '.join(drives[:3])}{' and more' if len(drives) > 3 else ''}"
        return ""


@runtime_checkable
class ImageStore(Protocol):
    """A source of pixels of many images."""

    provenance: Provenance

    def __len__(self) -> int: ...

    def read(self, index: int) -> Pixels:
        """Return the pixels of one image; several threads may call it at once."""
        ...


@runtime_checkable
class TimedStore(Protocol):
    """A source of pixels of images whose times and poses are known, or some of them."""

    motions: Sequence[Motion]


@runtime_checkable
class FileStore(Protocol):
    """A source of pixels of images that each lie in a file; some may share one."""

    files: Sequence[Path]


class RangeImages:
    """Range images in one or more stores, numbered through, of one sensor unless sets of several are joined.

    Args:
        sensor: sensor of the images; of several, that of the first.
        stores: sources of images that are as wide as the sensor's, or that have all of its fine columns.
    """

    def __init__(self, sensor: SensorModel, stores: Sequence[ImageStore]) -> None:
        self.sensor = sensor
        self._stores = [store for store in stores if len(store)]
        self._sensors = [sensor] * len(self._stores)
        self._ends = list(accumulate(len(store) for store in self._stores))

    @classmethod
    def joined(cls, sensor: SensorModel | None, parts: "Sequence[RangeImages]") -> "RangeImages":
        """Join the images of several sets into one set, in their order.

        Args:
            sensor: sensor of all of them; None where each set keeps its own.
        """
        found = cls(sensor or parts[0].sensor, [store for part in parts for store in part._stores])
        if sensor is None:
            found._sensors = [each for part in parts for each in part._sensors]
        return found

    def sensor_of(self, index: int) -> SensorModel:
        """Return the sensor of an image."""
        return self._sensors[bisect_right(self._ends, index)]

    def of_each_sensor(self) -> list[range]:
        """Return the numbers of the images that follow one another and have one sensor."""
        runs: list[range] = []
        for number, (start, end) in enumerate(pairwise([0, *self._ends])):
            goes_on = number and self._sensors[number] is self._sensors[number - 1]
            runs.append(range(runs.pop().start if goes_on else start, end))
        return runs

    def alike(self, indices: Sequence[int], at_most: int) -> list[list[int]]:
        """Divide indices into batches, in their order, of images of one sensor each.

        Args:
            at_most: largest number of images of a batch.
        """
        batches: list[list[int]] = []
        for index in indices:
            last = batches[-1] if batches else []
            if not last or len(last) == at_most or self.sensor_of(last[0]) is not self.sensor_of(index):
                batches.append([])
            batches[-1].append(index)
        return batches

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def files(self, index: int) -> Sequence[Path]:
        """Return the file that holds an image; none where it is not known."""
        part, number = self._located(index)
        store = self._stores[part]
        return store.files[number : number + 1] if isinstance(store, FileStore) else ()

    @property
    def provenance(self) -> Provenance:
        """Provenance of all images, in their order."""
        return Provenance.joined([store.provenance for store in self._stores])

    def timed_scans(self) -> list[TimedScan]:
        """Return when and where each image was made, as far as its store knows."""
        found = list[TimedScan]()
        for part, store in enumerate(self._stores):
            names = store.provenance.names or tuple(f"image {number}" for number in range(len(store)))
            recordings = store.provenance.recordings or ("",) * len(store)
            motions = store.motions if isinstance(store, TimedStore) else (Motion(),) * len(store)
            each = zip(names, recordings, motions, strict=True)
            found += [TimedScan(name, f"{part} {drive}", motion) for name, drive, motion in each]
        return found

    def with_fine_columns(self) -> "RangeImages":
        """Return the images with all fine columns of the sensor.

        Raises:
            DataError: when one is read that lacks them, as images that were not projected here do.
        """
        return RangeImages(self.sensor.fine(), self._stores)

    @cached_property
    def _planes(self) -> frozenset[str]:
        """Planes that the first usable image of every store has, and so all images must have that are read."""
        return frozenset.intersection(*(_first_planes(store) for store in self._stores))

    def batch(self, indices: Sequence[int], first_columns: Sequence[int] | None = None) -> RangeImage:
        """Return some images of one sensor as one batch (B, H, W).

        Args:
            indices: numbers of the images.
            first_columns: index of the fine column at which each image begins, below the sensor's column stride; 0 if
                not given.
        """
        first_columns = first_columns or [0] * len(indices)
        pixels = [self._pixels(index, first) for index, first in zip(indices, first_columns, strict=True)]
        range_m = torch.from_numpy(np.stack([one.range_m for one in pixels]))
        planes = {
            name: torch.from_numpy(np.stack([one.planes[name] for one in pixels]).astype(PLANES[name].dtype))
            for name in sorted(self._planes)
        }
        return RangeImage(range_m, range_m > 0, self.sensor_of(indices[0]) if indices else self.sensor, planes)

    def _located(self, index: int) -> tuple[int, int]:
        part = bisect_right(self._ends, index)
        return part, index - (self._ends[part - 1] if part else 0)

    def _pixels(self, index: int, first_column: int) -> Pixels:
        part, number = self._located(index)
        store = self._stores[part]
        whole = store.read(number)
        if lacking := self._planes - whole.planes.keys():
            names = store.provenance.names
            got = f"{names[number] if names else f'image {number}'} without {' and '.join(sorted(lacking))}"
            raise DataError(got, "what the first image beside it has", "remove it, or make all of them alike")
        width = self._sensors[part].width
        if whole.range_m.shape[1] < width:
            got = f"images of {whole.range_m.shape[1]} columns"
            raise DataError(got, f"all {width} fine columns", "name the scans that they were made of")
        kept = slice(first_column, None, whole.range_m.shape[1] // width)
        return Pixels(whole.range_m[:, kept], {name: whole.planes[name][:, kept] for name in self._planes})


def _first_planes(store: ImageStore) -> frozenset[str]:
    """Return the planes of the first usable image of a store; others are told of when they are asked for."""
    for index in range(len(store)):
        with suppress(LidarGritError):
            return frozenset(store.read(index).planes)
    return frozenset()
