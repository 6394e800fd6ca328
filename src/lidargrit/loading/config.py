"""Which scans, and how they become range images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from lidargrit.errors import ConfigError
from lidargrit.formats import BadPoints
from lidargrit.projection import Variant
from lidargrit.sensors import SensorModel, load_sensor


@dataclass(frozen=True)
class DataConfig:
    """Which scans, and how they become range images.

    Args:
        train: sources to learn from, each "NAME:ROOT:SPLIT", "FOLDER", "simulated:COUNT", or a prepared folder or URL.
        val: sources to watch, never learned from.
        sensor: name of a sensor, or a sensor's ``.json`` file.
        columns: fine columns of the circle; 0 for the sensor's own.
        column_stride: keep every n-th of them.
        projection: ``sensor`` for the sensor's own, ``spherical`` or ``unfolding``.
        projection_variant: ``exact``, or ``reference`` to repeat the released program's projection.
        max_scans: of each source, evenly spaced over it; 0 for all.
        bad_points: ``refuse`` scans with NaN, infinite or origin points, or ``drop`` these points.
        bad_scans: ``refuse`` to go on after a scan that cannot be used, or ``skip`` it and say so.
        workers: processes that prepare scans, and threads that read ahead while a model trains.
    """

    train: tuple[str, ...] = ()
    val: tuple[str, ...] = ()
    sensor: str = "hdl64e_kitti_odometry"
    columns: int = 0
    column_stride: int = 1
    projection: Literal["sensor", "spherical", "unfolding"] = "sensor"
    projection_variant: Variant = "exact"
    max_scans: int = 0
    bad_points: BadPoints = "refuse"
    bad_scans: Literal["refuse", "skip"] = "refuse"
    workers: int = 2

    def __post_init__(self) -> None:
        if self.max_scans < 0:
            raise ConfigError(f"max_scans={self.max_scans}", "at least 1, or 0 for all", "raise it")
        if self.column_stride != 1 and not self.columns:
            got = f"column_stride={self.column_stride} without columns"
            raise ConfigError(got, "both, or neither", "say of how many columns it is, as columns=2048")
        if not 1 <= self.workers <= 1024:
            raise ConfigError(f"workers={self.workers}", "1 to 1024", "choose about as many as there are cores")

    def load_sensor(self) -> SensorModel:
        """Return the sensor at the wanted number of columns and with the wanted projection."""
        sensor = load_sensor(self.sensor)
        if self.columns:
            sensor = sensor.with_columns(self.columns, self.column_stride)
        return sensor if self.projection == "sensor" else replace(sensor, projection=self.projection)
