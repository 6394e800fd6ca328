"""What every source of scans or images answers, whatever its kind."""

from abc import ABC, abstractmethod
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from lidargrit.core.errors import DataError
from lidargrit.data.datasets import ScanDataset
from lidargrit.data.images import Provenance, RangeImages
from lidargrit.data.prepared.config import DEFAULTS, DataConfig
from lidargrit.data.run_folder import trained_on
from lidargrit.scans.sensors import SensorModel


class Source(ABC):
    """A source of scans or range images; :func:`lidargrit.data.sources.open_source` recognises its kind.

    Args:
        text: name of the source, as the user typed it.
    """

    kind: ClassVar[str]
    """What the source is, in words for a message."""
    data_set: str = ""
    """Name of the data set; ``samples`` for what a generator made; "" where it is not known."""
    split: str = ""
    """Part of the data set, or the sample format of tensors; "" where there is none."""
    doubts: tuple[str, ...] = ()
    """Reasons to doubt the images that were opened last: made by another sensor, or of mixed scales of reflectance."""
    has_points: ClassVar[bool] = False
    """Whether it has the points of scans, not images of them alone: see :meth:`scans`."""
    projection_variant: str = ""
    """Variant of the projection by which its scans became images, or :meth:`images` made them; "" if not known."""
    folder: Path | None = None
    """Folder of the run, or of the samples, that tells which scans its model learned from."""
    weights_sha256: str = ""
    """Hash of the weights that generated the scans; "" where there are none, or it is not known."""
    full_rows: range | None = None
    """Rows in which every ray of generated scans returns, with none in the others; None where rays may drop."""

    def __init__(self, text: str) -> None:
        self.text = text

    @property
    @abstractmethod
    def sensor(self) -> SensorModel:
        """Sensor whose rays the scans or images lie on."""

    @property
    def sensor_name(self) -> str:
        """Name or file of the sensor that made the scans; "" for images, which hold theirs."""
        return ""

    @property
    def is_generated(self) -> bool:
        """Whether its images were generated, and so keep their sensor."""
        return self.data_set == "samples"

    def as_projected(self, config: DataConfig) -> DataConfig:
        """Return a configuration with the variant by which scans that are images already were projected."""
        return replace(config, projection_variant=self.projection_variant or config.projection_variant)

    @abstractmethod
    def images(self, sensor: SensorModel | None = None, config: DataConfig = DEFAULTS) -> RangeImages:
        """Return the range images of the source; pixels are read when they are asked for.

        Args:
            sensor: sensor that scans are projected with; the source's own if not given. Samples keep theirs.
            config: settings of reading and projecting scans; its sources and sensor are ignored.

        Raises:
            DataError: no usable scan, or prepared scans of another sensor or projection.
            ScanError: a scan or a sample that cannot be used.
        """

    def scans(self) -> ScanDataset:
        """Return the points of the scans; only a data set has them.

        Raises:
            DataError: a source that holds range images, or a run.
        """
        raise DataError(f"{self.text}, which holds {self.kind}", "the points of scans", "name a data set or its folder")

    def cut(self, num_points: int) -> "Source":
        """Return the source with the first points of each scan alone; itself where it holds images."""
        return self

    def learned_from(self) -> Provenance | None:
        """Return the training scans of the model behind the source; None where no model is behind it."""
        return None if self.folder is None else trained_on(self.folder)
