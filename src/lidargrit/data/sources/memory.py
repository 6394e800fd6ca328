"""Scans in memory → range images, as a source beside those that are named."""

from collections.abc import Sequence

from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import DataError
from lidargrit.data.images import Pixels, Provenance, RangeImages
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources.source import Source
from lidargrit.scans.projection import project_by_what_fits
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage, Scan


class MemorySource(Source):
    """Scans that a caller holds."""

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

    def images(self, sensor: SensorModel | None = None, config: DataConfig | None = None) -> RangeImages:
        """Project the scans, or so many of them, evenly spaced."""
        sensor, config = sensor or self.sensor, config or DataConfig()
        chosen = evenly_spaced(config.max_scans or len(self._scans), len(self._scans))
        self.projection_variant = by = config.projection_variant
        images = [project_by_what_fits(self._scans[index], sensor, by)[0] for index in chosen]
        return RangeImages(sensor, [_Images(images)])


class _Images:
    """Range images in memory as a store."""

    provenance = Provenance()

    def __init__(self, images: Sequence[RangeImage]) -> None:
        self._images = images

    def __len__(self) -> int:
        return len(self._images)

    def read(self, index: int) -> Pixels:
        """Return the pixels of one image."""
        image = self._images[index]
        return Pixels(image.range_m.numpy(), {name: pixels.numpy() for name, pixels in image.planes.items()})
