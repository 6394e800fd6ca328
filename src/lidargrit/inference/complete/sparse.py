"""Scans of a sensor with few rows → observed rows on the grid of a sensor with more rows."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from lidargrit.core.errors import ConfigError, ScanError
from lidargrit.inference.complete.inputs import InputScan, ScanReader
from lidargrit.scans.sensors import SensorModel, mean_azimuths_rad
from lidargrit.scans.types import RangeImage, Scan

_ROWS_AT_LEAST = 2


@dataclass(frozen=True)
class SparseReader(ScanReader):
    """How the points of a sensor with few rows become an image of :attr:`sensor`, in which most rows are unknown.

    Args:
        source: sensor of the scans.

    Raises:
        ConfigError: hardly a row of the one sensor looks where a row of the other does.
    """

    source: SensorModel | None = None

    def __post_init__(self) -> None:
        self._rows()

    def read(self, scan: Scan) -> InputScan:
        """Project a scan by its own sensor, and put each of its rows into the wanted row of the nearest elevation.

        A sensor that fires in fewer columns keeps its own: each gives its pixels to the wanted column of the nearest
        azimuth. A wanted column that is the nearest to none stays unknown, since no ray went there.
        """
        wanted = self.sensor
        seen = ScanReader(self._imaged, self.variant, self.partial).read(scan)
        assert seen.point_of_pixel is not None
        rows, of_column = self._rows(), self._columns()
        own, target, fired = (rows >= 0).nonzero()[:, 0], rows[rows >= 0], of_column >= 0

        def taken(pixels: Tensor, nothing: int = 0) -> Tensor:
            return torch.where(fired, pixels[own][:, of_column.clamp(min=0)], nothing)

        size = (wanted.height, wanted.width)
        range_m, on_grid = torch.zeros(size), torch.zeros(size, dtype=torch.bool)
        at = torch.full(size, -1, dtype=torch.int64)
        reflectance = None if seen.image.reflectance is None else torch.zeros(size)
        label = None if seen.image.label is None else torch.zeros(size, dtype=torch.int64)
        range_m[target], at[target], on_grid[target] = taken(seen.image.range_m), taken(seen.point_of_pixel, -1), fired
        if reflectance is not None and seen.image.reflectance is not None:
            reflectance[target] = taken(seen.image.reflectance)
        if label is not None and seen.image.label is not None:
            label[target] = taken(seen.image.label)
        within = (range_m >= wanted.range_min_m) & (range_m <= wanted.range_max_m)
        return InputScan(RangeImage.masked(range_m, within, wanted, reflectance, label), scan, at, on_grid, seen.doubt)

    @property
    def _imaged(self) -> SensorModel:
        """The scans' sensor with the columns of the wanted one, or with its own if it fires in fewer."""
        assert self.source is not None
        own, stride = self.source.fine(), self.sensor.column_stride
        columns = self.sensor.width * stride
        return own if own.width < columns else own.with_columns(columns, stride)

    def _columns(self) -> Int64[Tensor, " W"]:
        """Return for each wanted column that of the scans' image; -1 where this one is nearer to another wanted column.

        A pixel that lies between two rays of the same sensor was not seen, which is not the same as a lost return.
        """
        own, wanted = (mean_azimuths_rad(sensor.azimuth_rad) for sensor in (self._imaged, self.sensor))
        apart = (wanted[:, None] - own).abs().remainder(2 * math.pi)
        apart = torch.minimum(apart, 2 * math.pi - apart)
        nearest = apart.argmin(1)
        return torch.where(apart.argmin(0)[nearest] == torch.arange(len(wanted)), nearest, -1)

    def _rows(self) -> Int64[Tensor, " rows"]:
        """Return for each row of the scans' sensor the wanted row; -1 where none lies within three quarters of
        the step between wanted rows.

        Of several that fall on one wanted row, the nearest has it.
        """
        assert self.source is not None
        own = self.source.elevation_rad.double().mean(1).numpy()
        wanted = self.sensor.elevation_rad.double().mean(1).numpy()
        step_rad = np.gradient(wanted) if len(wanted) > 1 else np.zeros(1)
        distance = np.abs(own[:, None] - wanted[None, :])
        rows = distance.argmin(1)
        away = distance.min(1)
        rows = np.where(away <= np.abs(step_rad[rows]) * 0.75, rows, -1)
        for row in set(rows.tolist()) - {-1}:
            rivals = np.nonzero(rows == row)[0]
            rows[rivals[rivals != rivals[away[rivals].argmin()]]] = -1
        if (rows >= 0).sum() < _ROWS_AT_LEAST or (rows >= 0).sum() == len(wanted):
            span = [f"{math.degrees(edge):.1f}" for edge in (own[-1], own[0], wanted[-1], wanted[0])]
            raise ConfigError(
                f"scans of {self.source.name!r} with {len(own)} rows from {span[0]} to {span[1]} degrees",
                f"at least {_ROWS_AT_LEAST}, but not all of the {len(wanted)} rows of {self.sensor.name!r}, from "
                f"{span[2]} to {span[3]} degrees",
                "name the scans' sensor with --sensor, or complete them with: lidargrit complete",
            )
        return torch.from_numpy(rows.astype(np.int64))


def observed_rows(scan: InputScan) -> Bool[Tensor, "H W"]:
    """Return the pixels that a sparse scan covers: all of its rows, with a return or without.

    Raises:
        ScanError: a scan that was an image of all rows.
    """
    if scan.on_grid is None:
        raise ScanError(
            "a range image, which has no rows between its own",
            "points of a sensor with few rows",
            "name a file or a folder of point clouds",
        )
    return scan.on_grid
