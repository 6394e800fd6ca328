"""Sensors, by name or from a file: tables of ray directions and range limits → :class:`SensorModel`."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from lidargrit.core import configuration, discovery
from lidargrit.core.errors import ConfigError
from lidargrit.core.files import read_json
from lidargrit.core.untrusted import seed_number, user_path
from lidargrit.scans.sensors._checks import (
    FINE_COLUMNS_AT_MOST,
    check_projection,
    check_tables,
    checked_entries,
    column_azimuths_rad,
)
from lidargrit.scans.sensors._checks import NAME_AT_MOST as NAME_AT_MOST
from lidargrit.scans.sensors._checks import continuous_azimuths_rad as continuous_azimuths_rad
from lidargrit.scans.sensors._checks import mean_azimuths_rad as mean_azimuths_rad
from lidargrit.scans.sensors._setup import SensorSetup as SensorSetup

_DRAWN = "drawn_"
REACH_AT_MOST_M = 1000  # beyond, steps in which ranges are kept are coarser than 16 mm

ProjectionName = Literal["spherical", "unfolding"]
ProjectionOption = Literal["sensor", ProjectionName]  # the first: as the sensor has them


@dataclass(frozen=True, eq=False)
class SensorModel:
    """The ray directions of a range image and the limits of the sensor that fills it.

    Args:
        name: public name of the sensor.
        elevation_rad: elevation of every row (H, 1), or of every pixel (H, W), in radians, falling from row 0 down; up
            is positive.
        azimuth_rad: azimuth of every column (1, W), or of every pixel (H, W), in radians, falling from near +pi at
            column 0 to near -pi; counter-clockwise from +x is positive.
        range_min_m: shortest range of a return, in metres.
        range_max_m: longest range of a return, in metres.
        projection: default projection of the sensor's scans, ``spherical`` or ``unfolding``.
        column_stride: the image keeps every n-th of ``W * n`` fine columns (the paper's 64x256: every 8th of 2048).
        source: origin of the numbers, such as a data sheet.
        azimuth_offset_rad: angle (H,) from a column's azimuth, counter-clockwise, at which each row's laser fires. A
            point is placed by its own azimuth, so images do not depend on it; the simulator aims by it.
        first_edge_rad: azimuth at which column 0 begins, in radians. Half a column beyond +pi, columns have their
            centres where a sensor fires at whole multiples of a column (Ouster), and no point lies on a border.
        setup: noise, lasers and mounting of one unit, which the simulator takes. If not given, it takes that of the
            packaged sensor of this name, or samples one.

    Raises:
        ConfigError: tables whose shapes do not match, angles out of bounds, rows that do not fall, or limits that are
            not limits.
    """

    name: str
    elevation_rad: Float[Tensor, "H #W"]
    azimuth_rad: Float[Tensor, "#H W"]
    range_min_m: float
    range_max_m: float
    projection: ProjectionName
    column_stride: int = 1
    source: str = ""
    azimuth_offset_rad: Float[Tensor, "H"] | None = None
    first_edge_rad: float = math.pi
    setup: SensorSetup | None = None

    def __post_init__(self) -> None:
        if self.setup is not None:
            self.setup.check_rows(self.name, len(self.elevation_rad))
        tables = self.elevation_rad, self.azimuth_rad, self.azimuth_offset_rad
        check_tables(self.name, *tables, self.column_stride, self.first_edge_rad)
        check_projection(self.name, self.projection, get_args(ProjectionName))
        if not 0 < self.range_min_m < self.range_max_m <= REACH_AT_MOST_M:
            raise ConfigError(
                f"range limits {self.range_min_m:g} to {self.range_max_m:g} m for the sensor {self.name!r}",
                f"0 < range_min_m < range_max_m <= {REACH_AT_MOST_M:,} m",
                "correct the sensor's limits; if scans are in millimetres, divide them by 1000",
            )

    @property
    def height(self) -> int:
        """Number of rows, H."""
        return self.elevation_rad.shape[0]

    @property
    def width(self) -> int:
        """Number of columns, W."""
        return self.azimuth_rad.shape[1]

    def ray_directions(self) -> Float[Tensor, "H W 3"]:
        """Return the unit vector of every pixel's ray (x forward, y left, z up)."""
        elevation, azimuth = torch.broadcast_tensors(self.elevation_rad, self.azimuth_rad)
        horizontal = elevation.cos()
        return torch.stack((horizontal * azimuth.cos(), horizontal * azimuth.sin(), elevation.sin()), dim=-1)

    @property
    def has_angles_per_pixel(self) -> bool:
        """Whether pixels have angles of their own, not one elevation a row and one azimuth a column."""
        return self.elevation_rad.shape[1] > 1 or self.azimuth_rad.shape[0] > 1

    def with_columns(self, columns: int, stride: int = 1) -> "SensorModel":
        """Return this sensor with ``columns // stride`` columns: every ``stride``-th of ``columns`` equal ones.

        The azimuth of a kept column is that of its own centre, first_edge_rad - 2 pi (stride j + 1/2) / columns. Where
        columns begin beside +pi, so that the sensor's firings lie in their middle, more columns keep the firings there.
        """
        if not 1 <= columns <= FINE_COLUMNS_AT_MOST or stride < 1 or columns % stride:
            raise ConfigError(
                f"{columns} columns, one in {stride} kept",
                f"a multiple of the stride from 1 to {FINE_COLUMNS_AT_MOST}",
                "change one of the two",
            )
        if self.has_angles_per_pixel:
            raise ConfigError(
                f"another number of columns for {self.name!r}, which has angles for every pixel",
                "a sensor with one elevation a row and one azimuth a column",
                "use the sensor as it is",
            )
        edge_rad, own = self.first_edge_rad, self.width * self.column_stride
        if edge_rad != math.pi and columns > own:  # the old edge would be where a finer mode of the sensor fires
            fired_rad = math.remainder(edge_rad - math.pi / own - math.pi, 2 * math.pi / columns)
            edge_rad = math.pi + fired_rad + math.pi / columns
        azimuth_rad = column_azimuths_rad(columns, stride, edge_rad)
        return replace(self, azimuth_rad=azimuth_rad, column_stride=stride, first_edge_rad=edge_rad)

    def fine(self) -> "SensorModel":
        """Return this sensor with every fine column that it fires."""
        return self if self.column_stride == 1 else self.with_columns(self.width * self.column_stride)

    def to_json(self) -> dict[str, Any]:
        """Return the sensor as plain numbers and words, for a file."""
        data = {
            "name": self.name,
            "elevation_rad": self.elevation_rad.tolist(),
            "azimuth_rad": self.azimuth_rad.tolist(),
            "range_min_m": self.range_min_m,
            "range_max_m": self.range_max_m,
            "projection": self.projection,
            "column_stride": self.column_stride,
            "source": self.source,
        }
        if self.azimuth_offset_rad is not None:  # left out if there is none: files from before it existed look the same
            data["azimuth_offset_rad"] = self.azimuth_offset_rad.tolist()
        if self.first_edge_rad != math.pi:
            data["first_edge_rad"] = self.first_edge_rad
        if self.setup is not None:
            data["setup"] = configuration.to_json(self.setup)
        return data

    @classmethod
    def from_json(cls, data: Any) -> "SensorModel":
        """Rebuild a sensor from what :meth:`to_json` returned, or someone wrote by hand.

        Raises:
            ConfigError: an entry is missing, unknown, of another type or out of its bounds.
        """
        setup = data.get("setup") if isinstance(data, dict) else None
        if setup is None:
            return cls(**checked_entries(data, get_args(ProjectionName)))
        rest = {key: value for key, value in data.items() if key != "setup"}
        return cls(**checked_entries(rest, get_args(ProjectionName)), setup=_setup_of(setup))

    def same_rays(self, other: "SensorModel") -> bool:
        """Return whether two sensors look along the same rays, within a hundredth of a degree."""
        if (self.height, self.width) != (other.height, other.width):
            return False
        tolerance = math.radians(0.01)
        return torch.allclose(self.elevation_rad, other.elevation_rad, rtol=0, atol=tolerance) and torch.allclose(
            self.azimuth_rad, other.azimuth_rad, rtol=0, atol=tolerance
        )


def _setup_of(data: Any) -> SensorSetup:
    try:
        return configuration.rebuilt(SensorSetup, data)
    except (TypeError, ConfigError) as error:
        got = f"the set-up of a sensor with {error.got}" if isinstance(error, ConfigError) else f"a set-up: {error}"
        wanted = error.wanted if isinstance(error, ConfigError) else "the settings of SensorSetup"
        raise ConfigError(got, wanted, "correct the set-up, or leave it out") from None


Sensor: TypeAlias = SensorModel | str | Path
"""A sensor, its name, or its ``.json`` file."""


def load_sensor(name: Sensor) -> SensorModel:
    """Return a sensor by its name ("hdl64e_kitti_360", ...), from a ``.json`` file, or the drawn one of a seed
    ("drawn_7"); a sensor as it is.

    Raises:
        UnknownNameError: no sensor of that name; names its nearest neighbours.
        ConfigError: the file cannot be read, or does not hold a sensor.
    """
    if isinstance(name, SensorModel):
        return name
    name = str(name)
    if name.startswith(_DRAWN) and name.removeprefix(_DRAWN).isdecimal():
        from lidargrit.scans.drawn_sensors import drawn_sensor  # noqa: PLC0415  which shifts sensors that are loaded here

        return drawn_sensor(seed_number(name.removeprefix(_DRAWN)))
    if not name.lower().endswith(".json"):
        return discovery.load_instance("sensors", name, SensorModel)
    wanted, cure = "the JSON of a sensor", "write one with: lidargrit fit-sensor, or SensorModel.to_json"
    data = read_json(user_path(name, ConfigError), error=ConfigError, wanted=wanted, cure=cure)
    try:
        return SensorModel.from_json(data)
    except ConfigError as error:
        raise ConfigError(f"{error.got} in {name}", error.wanted, error.cure) from None
