"""Settings of the data: which scans are read, and how they become range images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from lidargrit.errors import ConfigError
from lidargrit.formats import BadPoints
from lidargrit.projection import ProjectionVariant
from lidargrit.sensors import SensorModel, load_sensor


@dataclass(frozen=True)
class DataConfig:
    """Which scans are read, and how they become range images.

    Args:
        train: sources of training scans: "NAME:ROOT:SPLIT", a folder, "simulated:COUNT", or a prepared folder or URL.
        val: sources of validation scans, which the model is tried on and does not learn from.
        sensor: name of a sensor, or path of a sensor's ``.json`` file.
        columns: number of fine columns over the whole circle; 0 for the sensor's own number.
        column_stride: step between the fine columns that an image keeps, such as 8 for every eighth.
        projection: ``spherical`` (rows by elevation), ``unfolding`` (rows by ring), or ``sensor`` for the sensor's own.
        projection_variant: ``exact``, or ``reference`` to repeat the projection of LidarGRIT's released program.
        max_scans: largest number of scans taken from each source, evenly spaced over it; 0 for all.
        bad_points: ``refuse`` a scan with points that are NaN, infinite or at the origin, or ``drop`` these points.
        bad_scans: ``refuse`` to go on when a scan cannot be used, or ``skip`` that scan with a message.
        workers: number of processes that prepare scans, and of threads that read ahead during training.
    """

    train: tuple[str, ...] = ()
    val: tuple[str, ...] = ()
    sensor: str = "hdl64e_kitti_odometry"
    columns: int = 0
    column_stride: int = 1
    projection: Literal["sensor", "spherical", "unfolding"] = "sensor"
    projection_variant: ProjectionVariant = "exact"
    max_scans: int = 0
    bad_points: BadPoints = "refuse"
    bad_scans: Literal["refuse", "skip"] = "refuse"
    workers: int = 2

    def __post_init__(self) -> None:
        if self.max_scans < 0:
            raise ConfigError(f"max_scans={self.max_scans}", "at least 1, or 0 for all", "raise it")
        if self.column_stride != 1 and not self.columns:
            got = f"column_stride={self.column_stride} without columns"
            raise ConfigError(got, "both, or neither", "give the number of fine columns too, as columns=2048")
        if not 1 <= self.workers <= 1024:
            raise ConfigError(f"workers={self.workers}", "1 to 1024", "choose about as many as there are cores")

    def load_sensor(self) -> SensorModel:
        """Return the sensor with these columns and this projection."""
        sensor = load_sensor(self.sensor)
        if self.columns:
            sensor = sensor.with_columns(self.columns, self.column_stride)
        return sensor if self.projection == "sensor" else replace(sensor, projection=self.projection)
