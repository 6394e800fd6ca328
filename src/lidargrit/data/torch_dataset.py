"""A source of scans → a data set for torch's own loaders, with images as dictionaries of tensors."""

import os
from collections.abc import Sequence
from typing import Any

from torch import Tensor
from torch.utils.data import Dataset

from lidargrit.core.errors import UsageError
from lidargrit.data.images import RangeImages
from lidargrit.data.sources import open_images
from lidargrit.scans.sensors import SensorModel


class TorchDataset(Dataset[dict[str, Tensor]]):
    """Range images of a source by their number; torch's loaders shuffle them, and join them into batches.

    An item has ``range_m`` (H, W) in metres, 0 where no return is, ``return_mask`` (H, W), and of ``reflectance`` and
    ``label`` what the source has. A process that a loader starts opens the source for itself, so that the same items
    come whatever their number; it must not be forked (``multiprocessing_context="forkserver"`` or ``"spawn"``).

    Args:
        source: samples, prepared scans, a data set, a folder, or "simulated:COUNT"; see
            :func:`lidargrit.data.sources.open_source`.
        sensor: sensor that scans are projected with; the source's own if not given. Samples keep theirs.
    """

    def __init__(self, source: str, sensor: SensorModel | None = None) -> None:
        self.source, self._sensor, self._process = source, sensor, os.getpid()
        self._images: RangeImages | None = open_images(source, sensor)
        self._count = len(self._images)

    @property
    def sensor(self) -> SensorModel:
        """Sensor whose rays are the pixels."""
        return self._opened().sensor

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        if not -self._count <= index < self._count:
            raise IndexError(f"image {index} of {self._count}")
        return self.__getitems__([index % self._count])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, Tensor]]:
        batch = self._opened().batch(indices)
        planes = {"range_m": batch.range_m, "return_mask": batch.return_mask, **batch.planes}
        return [{name: plane[at] for name, plane in planes.items()} for at in range(len(indices))]

    def _opened(self) -> RangeImages:
        if self._images is None:
            self._images, self._process = open_images(self.source, self._sensor), os.getpid()
        if self._process != os.getpid():
            got, wanted = "a process of a loader that was forked", "one that begins anew"
            raise UsageError(got, wanted, 'give the loader multiprocessing_context="forkserver"')
        return self._images

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_images": None}
