"""Scans of a sensor with few rows → observed rows on the grid of a sensor with more rows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from lidargrit.completion.inputs import InputScan, ScanReader
from lidargrit.errors import ConfigError, ScanError
from lidargrit.sensors import SensorModel
from lidargrit.structures import RangeImage, Scan

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
        """Project a scan by its own sensor, and put each of its rows into the wanted row of the nearest elevation."""
        wanted = self.sensor
        seen = ScanReader(self._source_like_wanted(), self.variant, self.partial).read(scan)
        assert seen.point_of_pixel is not None
        size = (wanted.height, wanted.width)
        range_m, on_grid = torch.zeros(size), torch.zeros(size, dtype=torch.bool)
        at = torch.full(size, -1, dtype=torch.int64)
        reflectance = None if seen.image.reflectance is None else torch.zeros(size)
        label = None if seen.image.label is None else torch.zeros(size, dtype=torch.int64)
        rows = self._rows()
        own, target = (rows >= 0).nonzero()[:, 0], rows[rows >= 0]
        range_m[target], at[target], on_grid[target] = seen.image.range_m[own], seen.point_of_pixel[own], True
        if reflectance is not None and seen.image.reflectance is not None:
            reflectance[target] = seen.image.reflectance[own]
        if label is not None and seen.image.label is not None:
            label[target] = seen.image.label[own]
        within = (range_m >= wanted.range_min_m) & (range_m <= wanted.range_max_m)
        return InputScan(RangeImage.masked(range_m, within, wanted, reflectance, label), scan, at, on_grid, seen.doubt)

    def _source_like_wanted(self) -> SensorModel:
        """Return the scans' sensor with as many columns as the wanted one."""
        assert self.source is not None
        stride = self.sensor.column_stride
        return self.source.with_columns(self.sensor.width * stride, stride)

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
