"""A store of range images that a seed determines."""

import numpy as np

from lidargrit.data.images import Pixels, Provenance
from lidargrit.scans.sensors import SensorModel


class SeededImages:
    """Range images of a sensor in which every ray returns; reflectance is not known.

    Args:
        sensor: sensor whose rays are the pixels.
        count: number of images.
    """

    provenance = Provenance()

    def __init__(self, sensor: SensorModel, count: int) -> None:
        self._sensor, self._count = sensor, count

    def __len__(self) -> int:
        return self._count

    def read(self, index: int) -> Pixels:
        size = (self._sensor.height, self._sensor.width)
        return Pixels(np.random.default_rng(index).uniform(2, 50, size).astype(np.float32))
