"""Scans in memory, or the first points of each scan of a data set → range images, as a source beside those named."""

from collections.abc import Iterable, Sequence

import torch

from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import DataError
from lidargrit.data.datasets import ScanDataset
from lidargrit.data.images import Pixels, Provenance, RangeImages
from lidargrit.data.prepared.config import DEFAULTS, DataConfig
from lidargrit.data.sources.source import Source
from lidargrit.scans.projection import project_by_what_fits, projection_that_fits
from lidargrit.scans.projection.sensor_check import told_doubts
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

    def cut(self, num_points: int) -> Source:
        """Return the source with the first points of each scan alone."""
        found = MemorySource([_first_points(scan, num_points) for scan in self._scans], self._sensor)
        found.doubts = (_told(self, num_points),)
        return found

    def images(self, sensor: SensorModel | None = None, config: DataConfig = DEFAULTS) -> RangeImages:
        """Project the scans, or so many of them, evenly spaced."""
        self.projection_variant, first, rays = config.projection_variant, self._scans[0], sensor or self.sensor
        found = told_doubts(first, rays, projection_that_fits(first, rays), self.text)
        self.doubts = tuple(dict.fromkeys((*self.doubts, *filter(None, found))))
        chosen = evenly_spaced(config.max_scans or len(self._scans), len(self._scans))
        return _imaged((self._scans[index] for index in chosen), rays, config, Provenance())


class ImagesInMemory(Source):
    """Range images that a caller holds, such as samples of a generator.

    Args:
        images: batch of images (B, H, W).
    """

    kind, data_set = "range images in memory", "samples"

    def __init__(self, images: RangeImage) -> None:
        batch = RangeImage.stack([images]) if images.range_m.ndim == 2 else images
        super().__init__(f"{len(batch)} range images in memory")
        self._batch = batch.to("cpu")

    @property
    def sensor(self) -> SensorModel:
        """Sensor of the images."""
        return self._batch.sensor

    def images(self, sensor: SensorModel | None = None, config: DataConfig = DEFAULTS) -> RangeImages:
        """Return the images, or so many of them, evenly spaced."""
        chosen = evenly_spaced(config.max_scans or len(self._batch), len(self._batch))
        return RangeImages(self.sensor, [_Images([self._batch[index] for index in chosen], Provenance())])


class CutSource(Source):
    """The scans of a data set, each without what lies behind the first points of its file.

    Args:
        num_points: largest number of points of a scan.
    """

    kind, has_points = "scans", True

    def __init__(self, source: Source, num_points: int) -> None:
        super().__init__(source.text)
        self.data_set, self.split = source.data_set, source.split
        self._source, self._num_points = source, num_points
        self.doubts = (_told(source, num_points),)

    @property
    def sensor(self) -> SensorModel:
        """Sensor that made the scans."""
        return self._source.sensor

    def scans(self) -> ScanDataset:
        """Return the scans with all their points."""
        return self._source.scans()

    def images(self, sensor: SensorModel | None = None, config: DataConfig = DEFAULTS) -> RangeImages:
        """Project the first points of the scans, or of so many of them, evenly spaced."""
        scans, self.projection_variant = self.scans(), config.projection_variant
        chosen = evenly_spaced(config.max_scans or len(scans), len(scans))
        names, drives = (tuple(of(index) for index in chosen) for of in (scans.name, scans.recording))
        cut = (_first_points(scans.scan(index), self._num_points) for index in chosen)
        return _imaged(cut, sensor or config.with_projection(self.sensor), config, Provenance(names, drives))


def _told(source: Source, num_points: int) -> str:
    return f"of each cloud of {source.text} the first {num_points:,} points alone are scored, as by that program"


def _first_points(scan: Scan, num_points: int) -> Scan:
    return scan.select(torch.arange(min(num_points, len(scan))))


def _imaged(scans: Iterable[Scan], sensor: SensorModel, config: DataConfig, provenance: Provenance) -> RangeImages:
    images = [project_by_what_fits(scan, sensor, config.projection_variant)[0] for scan in scans]
    return RangeImages(sensor, [_Images(images, provenance)])


class _Images:
    def __init__(self, images: Sequence[RangeImage], provenance: Provenance) -> None:
        self._images, self.provenance = images, provenance

    def __len__(self) -> int:
        return len(self._images)

    def read(self, index: int) -> Pixels:
        image = self._images[index]
        return Pixels(image.range_m.numpy(), {name: pixels.numpy() for name, pixels in image.planes.items()})
