"""Settings of the data: which scans are read, and how they become range images."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

from lidargrit.core.configuration import Settings, override
from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Bounds, Count, NotNegative
from lidargrit.data.formats import BadPoints
from lidargrit.scans.projection import ProjectionVariant
from lidargrit.scans.sensors import ProjectionOption, SensorModel, load_sensor


@dataclass(frozen=True)
class DataConfig(Settings):
    """Which scans are read, and how they become range images.

    Args:
        train: sources of training scans: "NAME:ROOT:SPLIT", a folder, "simulated:COUNT", or a prepared folder or URL.
        val: sources of validation scans, which the model is tried on and does not learn from.
        sensor: name of a sensor, or path of a sensor's ``.json`` file.
        columns: number of fine columns over the whole circle; 0 for the sensor's own number.
        column_stride: step between the fine columns that an image keeps, such as 8 for every eighth.
        own_sensors: whether each source of training or validation scans keeps its own sensor and its columns, for a
            model of any sensor; ``sensor`` and ``columns`` are then those of the scans that it samples.
        projection: ``spherical`` (rows by elevation), ``unfolding`` (rows by ring), or ``sensor`` for the sensor's own.
        projection_variant: ``exact``; ``reference`` repeats the projection of LidarGRIT's program, ``clamped`` that of
            R2DM's, LiDARGen's and LiDARCrafter's.
        condition: name of what a generator is told of each training scan, from: lidargrit list conditions.
        max_scans: largest number of scans taken from each source, evenly spaced over it; 0 for all.
        bad_points: ``refuse`` a scan with points that are NaN, infinite or at the origin, or ``drop`` these points.
        bad_scans: ``refuse`` to go on when a scan cannot be used, or ``skip`` that scan with a message.
        workers: number of processes that prepare scans, and of threads that read ahead during training.
    """

    train: tuple[str, ...] = ()
    val: tuple[str, ...] = ()
    sensor: str = "hdl64e_kitti_odometry"
    columns: NotNegative = 0
    column_stride: Count = 1
    own_sensors: bool = False
    projection: ProjectionOption = "sensor"
    projection_variant: ProjectionVariant = "exact"
    condition: str = "nothing"
    max_scans: NotNegative = 0
    bad_points: BadPoints = "refuse"
    bad_scans: Literal["refuse", "skip"] = "refuse"
    workers: Annotated[int, Bounds(1, 1024)] = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.column_stride != 1 and not self.columns:
            got = f"column_stride={self.column_stride} without columns"
            raise ConfigError(got, "both, or neither", "give the number of fine columns too, as columns=2048")

    def load_sensor(self) -> SensorModel:
        """Return the sensor with these columns and this projection."""
        return self.with_projection(load_sensor(self.sensor))

    def with_projection(self, sensor: SensorModel) -> SensorModel:
        """Return another sensor with these columns and this projection."""
        if self.columns:
            sensor = sensor.with_columns(self.columns, self.column_stride)
        return sensor if self.projection == "sensor" else replace(sensor, projection=self.projection)


DEFAULTS = DataConfig()
"""How scans are read and projected where nothing is named."""


@dataclass(frozen=True)
class ScanSettings:
    """Settings of reading scans from a command line, the same for all commands.

    Args:
        sensor: name or ``.json`` file of the sensor; "" if none is named.
        projection_variant: variant of the projection; None if none is named.
    """

    data: DataConfig = field(default_factory=DataConfig)
    sensor: str = ""
    projection_variant: ProjectionVariant | None = None

    @classmethod
    def read(cls, settings: Sequence[str] = (), **options: str | int | None) -> "ScanSettings":
        """Read words such as ``data.projection=spherical``, and options that have a name of their own.

        Args:
            settings: words of the form data.NAME=VALUE.
            options: values by the names of :class:`DataConfig`; None or "" for those that the user did not give. They
                come after the words.
        """
        words = [*settings, *(f"data.{name}={value}" for name, value in options.items() if value not in (None, ""))]
        owner, cure = "reading scans", "name one with data. before it, as data.projection=spherical"
        data = override(
            cls(), words, owner, cure, ("data.train", "data.val", "data.condition", "sensor", "projection_variant")
        ).data
        named = {word.partition("=")[0].strip() for word in words}
        variant = data.projection_variant if "data.projection_variant" in named else None
        return cls(data, data.sensor if "data.sensor" in named else "", variant)

    def load_sensor(self) -> SensorModel | None:
        """Return the sensor that is named, with the wanted columns and projection; None if none is named."""
        return self.data.load_sensor() if self.sensor else None


NOTHING_NAMED = ScanSettings()
