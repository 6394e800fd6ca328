"""Scans in memory → range images, as a source beside those that are named."""

from collections.abc import Sequence

from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import DataError
from lidargrit.data.images import Pixels, Provenance, RangeImages
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources.source import Source
from lidargrit.scans.projection import project, projection_that_fits
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage, Scan


class MemorySource(Source):
    """Scans that a caller holds.

    Args:
        scans: points of each scan.
    """

    kind = "scans in memory"

    def __init__(self, scans: Sequence[Scan], sensor: SensorModel) -> None:
        super().__init__(f"{len(scans)} scans in memory")
        if not scans:
            raise DataError("no scan in memory", "at least one", "give some")
        self._scans, self._sensor = scans, sensor

    @property
    def sensor(self) -> SensorModel:
        """Sensor that made the scans."""
        return self._sensor

    def projection_variant(self, config: DataConfig) -> str:
        """Return the variant that the configuration names."""
        return config.projection_variant

    def images(self, sensor: SensorModel | None = None, config: DataConfig | None = None) -> RangeImages:
        """Project the scans, or so many of them, evenly spaced."""
        sensor, config = sensor or self.sensor, config or DataConfig()
        chosen = evenly_spaced(config.max_scans or len(self._scans), len(self._scans))
        images = []
        for scan in (self._scans[index] for index in chosen):
            method = projection_that_fits(scan, sensor)
            variant = config.projection_variant if method == sensor.projection else "exact"
            images.append(project(scan, sensor, method, variant))
        return RangeImages(sensor, [_Images(images)])


class _Images:
    """Range images in memory as a store."""

    provenance = Provenance()

    def __init__(self, images: Sequence[RangeImage]) -> None:
        self._images = images

    def __len__(self) -> int:
        return len(self._images)

    def read(self, index: int) -> Pixels:
        """Return the ranges of one image."""
        return Pixels(self._images[index].range_m.numpy())
