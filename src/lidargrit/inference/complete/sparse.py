"""Scans of a sensor with few rows → observed rows on the grid of a sensor with more rows."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from lidargrit.core.errors import ConfigError, ScanError
from lidargrit.inference.complete.inputs import InputScan, ScanReader
from lidargrit.scans.projection.pixel_coordinates import PixelCoordinates, pixel_coordinates
from lidargrit.scans.sensors import SensorModel, mean_azimuths_rad
from lidargrit.scans.types import RangeImage, Scan

_ROWS_AT_LEAST = 2


@dataclass(frozen=True)
class SparseReader(ScanReader):
    """How the points of a sensor with few rows become an image of :attr:`sensor`, in which most rows are unknown."""

    source: SensorModel | None = None

    def __post_init__(self) -> None:
        self._rows()

    def read(self, scan: Scan) -> InputScan:
        """Project a scan by its own sensor, and put each of its rows into the wanted row of the nearest elevation.

        A sensor that fires in fewer columns keeps its own: each gives its pixels to the wanted column that it lies in.
        A wanted column in which none lies stays unknown, since no ray went there.
        """
        wanted = self.sensor
        seen = ScanReader(self._imaged, self.variant, self.partial, self.projection).read(scan)
        assert seen.point_of_pixel is not None
        rows, of_column = self._rows(), self._columns()
        own, target, fired = (rows >= 0).nonzero()[:, 0], rows[rows >= 0], of_column >= 0

        def taken(pixels: Tensor, nothing: int = 0) -> Tensor:
            return torch.where(fired, pixels[own][:, of_column.clamp(min=0)], nothing)

        size = (wanted.height, wanted.width)
        range_m, on_grid = torch.zeros(size), torch.zeros(size, dtype=torch.bool)
        at = torch.full(size, -1, dtype=torch.int64)
        range_m[target], at[target], on_grid[target] = taken(seen.image.range_m), taken(seen.point_of_pixel, -1), fired
        planes = {name: pixels.new_zeros(size) for name, pixels in seen.image.planes.items()}
        for name, pixels in planes.items():
            pixels[target] = taken(seen.image.planes[name])
        within = (range_m >= wanted.range_min_m) & (range_m <= wanted.range_max_m)
        image = RangeImage.masked(range_m, within, wanted, planes)
        return InputScan(image, scan, at, on_grid, seen.doubt, self._coordinates(scan, seen, rows))

    def _coordinates(self, scan: Scan, seen: InputScan, rows: Int64[Tensor, " rows"]) -> PixelCoordinates:
        """Return the pixel of every point: in the row of its laser, or by elevation where that has none."""
        wanted, own = self.sensor, seen.coordinates
        by_elevation = pixel_coordinates(scan, wanted, "spherical", "exact")
        of_laser = rows.numpy()[own.row.clip(0, own.height - 1)]
        row = np.where(own.in_rows() & (of_laser >= 0), of_laser, by_elevation.row)
        return replace(by_elevation, row=row, column=by_elevation.column // wanted.column_stride, width=wanted.width)

    @property
    def _imaged(self) -> SensorModel:
        """The scans' sensor with the columns of the wanted one, or with its own if it fires in fewer."""
        assert self.source is not None
        own, wanted = self.source.fine(), self.sensor
        if own.width < wanted.width * wanted.column_stride:
            return own
        columns = {"azimuth_rad": wanted.azimuth_rad.double().mean(0, keepdim=True).float()}
        columns |= {"column_stride": wanted.column_stride, "first_edge_rad": wanted.first_edge_rad}
        return replace(own, **columns)

    def _columns(self) -> Int64[Tensor, " W"]:
        """Return for each wanted column that of the scans' image whose azimuth lies in it, -1 where none does.

        Of several the one nearest to its middle counts. A pixel that lies between two rays of the same sensor was not
        seen, which is not the same as a lost return.
        """
        own, wanted = (mean_azimuths_rad(sensor.azimuth_rad) for sensor in (self._imaged, self.sensor))
        width = len(wanted)
        # A column begins half a column before its middle, and its end is that of the next: so no azimuth is in two.
        at = ((wanted[0] - own) * (width / (2 * math.pi)) + 0.5).remainder(width)
        column = at.floor().long().clamp(max=width - 1)
        nearest_last = torch.argsort((at - column - 0.5).abs(), descending=True, stable=True).numpy()
        found = np.full(width, -1)
        found[column.numpy()[nearest_last]] = nearest_last  # of several writes to a column the last one stays
        return torch.from_numpy(found)

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
    """Return the pixels that a sparse scan covers: all of its rows, with a return or without."""
    if scan.on_grid is None:
        raise ScanError(
            "a range image, which has no rows between its own",
            "points of a sensor with few rows",
            "name a file or a folder of point clouds",
        )
    return scan.on_grid
