"""A store of range images that a seed determines."""

import numpy as np

from lidargrit.data.images import Pixels, Provenance
from lidargrit.scans.sensors import SensorModel


class SeededImages:
    """Range images of a sensor in which every ray returns.

    Args:
        sensor: sensor whose rays are the pixels.
        count: number of images.
        reflectance: reflectance of all pixels; not known if not given.
    """

    provenance = Provenance()

    def __init__(self, sensor: SensorModel, count: int, reflectance: float | None = None) -> None:
        self._sensor, self._count, self._reflectance = sensor, count, reflectance

    def __len__(self) -> int:
        return self._count

    def read(self, index: int) -> Pixels:
        size = (self._sensor.height, self._sensor.width)
        known = {} if self._reflectance is None else {"reflectance": np.full(size, self._reflectance, np.float32)}
        return Pixels(np.random.default_rng(index).uniform(2, 50, size).astype(np.float32), known)
