"""Range images on disk → batches in memory, of only the images that are asked for."""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32, UInt16

from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage


class Pixels(NamedTuple):
    """The pixels of one image.

    Args:
        label: class by SemanticKITTI's numbers, 0 where it is not known; None if it is not known anywhere.
    """

    range_m: Float32[np.ndarray, "H W"]
    reflectance: Float32[np.ndarray, "H W"] | None = None
    label: UInt16[np.ndarray, "H W"] | None = None


@dataclass(frozen=True)
class Provenance:
    """Where images come from; two provenances show which scans or drives two sets share.

    Args:
        names: one name for each image: the file of its scan, or another identifier.
        recordings: names of the drives that the images were cut from; empty for generated scans.
        fingerprints: one hash of the pixels for each image; empty where it is not known.
        range_fingerprints: one hash of the ranges for each image, without reflectance; empty where it is not known.
    """

    names: tuple[str, ...] = ()
    recordings: tuple[str, ...] = ()
    fingerprints: tuple[str, ...] = ()
    range_fingerprints: tuple[str, ...] = ()

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


class RangeImages:
    """Range images of one sensor, in one or more stores, numbered through.

    Args:
        stores: sources of images that are as wide as the sensor's, or that have all of its fine columns.
    """

    def __init__(self, sensor: SensorModel, stores: Sequence[ImageStore]) -> None:
        self.sensor = sensor
        self._stores = [store for store in stores if len(store)]
        self._ends = list(accumulate(len(store) for store in self._stores))

    @classmethod
    def joined(cls, sensor: SensorModel, parts: "Sequence[RangeImages]") -> "RangeImages":
        """Join the images of several sets into one set, in their order."""
        return cls(sensor, [store for part in parts for store in part._stores])

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    @property
    def provenance(self) -> Provenance:
        """Provenance of all images, in their order."""
        parts = [store.provenance for store in self._stores]
        return Provenance(
            tuple(name for part in parts for name in part.names),
            tuple(recording for part in parts for recording in part.recordings),
            tuple(fingerprint for part in parts for fingerprint in part.fingerprints),
            tuple(fingerprint for part in parts for fingerprint in part.range_fingerprints),
        )

    @cached_property
    def _all_have_reflectance(self) -> bool:
        """Whether the first image of every store has reflectance; batches with it and without it would not mix."""
        return all(store.read(0).reflectance is not None for store in self._stores)

    @cached_property
    def _all_have_label(self) -> bool:
        return all(store.read(0).label is not None for store in self._stores)

    def batch(self, indices: Sequence[int], first_columns: Sequence[int] | None = None) -> RangeImage:
        """Return some images as one batch (B, H, W).

        Args:
            indices: numbers of the images.
            first_columns: index of the fine column at which each image begins, below the sensor's column stride; 0 if
                not given.
        """
        first_columns = first_columns or [0] * len(indices)
        pixels = [self._pixels(index, first) for index, first in zip(indices, first_columns, strict=True)]
        range_m = torch.from_numpy(np.stack([one.range_m for one in pixels]))
        reflectance, label = (
            torch.from_numpy(np.stack(found)) if found and len(found) == len(pixels) else None
            for found in (
                [one.reflectance for one in pixels if one.reflectance is not None and self._all_have_reflectance],
                [one.label.astype(np.int64) for one in pixels if one.label is not None and self._all_have_label],
            )
        )
        return RangeImage(range_m, range_m > 0, self.sensor, reflectance, label)

    def _pixels(self, index: int, first_column: int) -> Pixels:
        part = bisect_right(self._ends, index)
        whole = self._stores[part].read(index - (self._ends[part - 1] if part else 0))
        kept = slice(first_column, None, whole.range_m.shape[1] // self.sensor.width)
        reflectance, label = (None if one is None else one[:, kept] for one in whole[1:])
        return Pixels(whole.range_m[:, kept], reflectance, label)
