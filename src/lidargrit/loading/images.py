"""Many range images that read like a list; only those asked for are in memory."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32

from lidargrit.sensors import SensorModel
from lidargrit.structures import RangeImage

Pixels = tuple[Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W"] | None]
"""Range in metres, 0 where nothing returned; reflectance in [0, 1] if it is known."""


@dataclass(frozen=True)
class Provenance:
    """Where images come from, so that it can be told what two sets share.

    Args:
        names: of each image: the file of its scan, or what else identifies it.
        recordings: the drives that images were cut from; none for generated scans.
        fingerprints: equal for equal pixels; none where that is not known.
    """

    names: tuple[str, ...] = ()
    recordings: tuple[str, ...] = ()
    fingerprints: tuple[str, ...] = ()

    def overlap(self, other: Provenance) -> str:
        """Say in a few words what two sets have in common that they should not, "" if nothing is known to be.

        The same scan is told by its file or by its pixels, and scans of one drive, which show the same streets, by the
        recording, also where one recording is in several data sets.
        """
        scans = max(len(set(self.names) & set(other.names)), len(set(self.fingerprints) & set(other.fingerprints)))
        if scans:
            return f"{scans} {'scans are' if scans > 1 else 'scan is'} in both"
        drives = sorted(set(self.recordings) & set(other.recordings) - {""})
        if drives:
            return f"both have scans of {', '.join(drives[:3])}{' and more' if len(drives) > 3 else ''}"
        return ""


@runtime_checkable
class ImageStore(Protocol):
    """Where the pixels of many images lie."""

    provenance: Provenance

    def __len__(self) -> int: ...

    def read(self, index: int) -> Pixels:
        """Return the pixels of one image; may be called from several threads."""
        ...


class RangeImages:
    """Range images on disk that read like a list.

    Args:
        sensor: of the images that are read.
        stores: of images as wide as the sensor's, or with all the fine columns of which the sensor keeps some.
    """

    def __init__(self, sensor: SensorModel, stores: Sequence[ImageStore]) -> None:
        self.sensor = sensor
        self._stores = [store for store in stores if len(store)]
        self._ends = list(accumulate(len(store) for store in self._stores))

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    @property
    def provenance(self) -> Provenance:
        """Where the images come from."""
        parts = [store.provenance for store in self._stores]
        return Provenance(
            tuple(name for part in parts for name in part.names),
            tuple(recording for part in parts for recording in part.recordings),
            tuple(fingerprint for part in parts for fingerprint in part.fingerprints),
        )

    @cached_property
    def _all_have_reflectance(self) -> bool:
        """Tell it by the first image of every store: batches that have it now and then would be of no use."""
        return all(store.read(0)[1] is not None for store in self._stores)

    def batch(self, indices: Sequence[int], first_columns: Sequence[int] | None = None) -> RangeImage:
        """Return the images of these indices as one batch, each from its own first fine column on."""
        first_columns = first_columns or [0] * len(indices)
        pixels = [self._pixels(index, first) for index, first in zip(indices, first_columns, strict=True)]
        range_m = torch.from_numpy(np.stack([one for one, _ in pixels]))
        known = [reflectance for _, reflectance in pixels if reflectance is not None and self._all_have_reflectance]
        reflectance = torch.from_numpy(np.stack(known)) if known and len(known) == len(pixels) else None
        return RangeImage(range_m, range_m > 0, self.sensor, reflectance)

    def _pixels(self, index: int, first_column: int) -> Pixels:
        part = bisect_right(self._ends, index)
        range_m, reflectance = self._stores[part].read(index - (self._ends[part - 1] if part else 0))
        kept = slice(first_column, None, range_m.shape[1] // self.sensor.width)
        return range_m[:, kept], None if reflectance is None else reflectance[:, kept]
