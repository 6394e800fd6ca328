"""The rays of a whole cloud as images of a model: one for every column at which the model's columns may begin."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from lidargrit.core.determinism import derive_seed, scan_seed
from lidargrit.scans.condition import Observed
from lidargrit.scans.projection.sensor_check import known_rings
from lidargrit.scans.sensors import SensorModel, column_azimuths_rad
from lidargrit.scans.types import RangeImage, Scan

_PHASES_AT_MOST = 32  # of 256 columns: 8,192 in all, four times those of the finest sensor in the package
_ALMOST = 0.25  # of a model's width that a sensor may lack: an HDL-64E of 2,000 columns is imaged in 2,048
_STEPS_AT_LEAST = 500  # between neighbouring points; fewer do not show how many columns a sensor fires
_IN_COLUMNS = 0.5  # of 1, by which all points lie at one place in their columns; about 0 where they lie anywhere
_ONE_RAY_RAD = 2 * math.pi / 40_000  # several returns of one ray lie closer


@dataclass(frozen=True, eq=False)
class RayGrid:
    """The rows of a model in so many columns as a cloud has, which are several images of the model side by side.

    Image number p takes the columns p, p + phases, p + 2 phases, ... A model has learned images that begin at any
    fine column, so that each of these is an image like those it knows, and every column is in one of them.

    Args:
        sensor: sensor of all rays: the model's rows, and ``phases`` times its columns.
        phases: number of images.
    """

    model: SensorModel
    sensor: SensorModel
    phases: int = 1

    @classmethod
    def fitting(cls, model: SensorModel, columns: int, first_edge_rad: float | None = None) -> "RayGrid":
        """Return the grid with about as many columns as a cloud has, and at most as many.

        Args:
            columns: number of columns in which the cloud's sensor fires; the model's fine ones where it is 0, unknown.
            first_edge_rad: azimuth at which the first of these columns begins; that of the model if not given.
        """
        if model.has_angles_per_pixel:  # no others
            return cls(model, model)
        phases = math.floor(columns / model.width + _ALMOST) if columns else model.column_stride
        phases = min(max(phases, 1), _PHASES_AT_MOST)
        width = phases * model.width
        edge_rad = model.first_edge_rad if first_edge_rad is None or columns != width else first_edge_rad
        azimuth_rad = column_azimuths_rad(width, first_edge_rad=edge_rad)
        fine = replace(model, azimuth_rad=azimuth_rad, column_stride=1, first_edge_rad=edge_rad)
        return cls(model, fine, phases)

    def images(self, image: RangeImage) -> RangeImage:
        """Return one image (H, columns) of the grid as a batch of images of the model."""
        size = (self.model.height, self.model.width, self.phases)
        return image.mapped(lambda pixels: pixels.reshape(size).movedim(-1, 0).contiguous(), self.model)

    def joined(self, images: RangeImage) -> RangeImage:
        """Return a batch of images of the model, one for each phase, as one image of the grid."""
        size = (self.sensor.height, self.sensor.width)
        return images.mapped(lambda pixels: pixels.movedim(0, -1).reshape(size), self.sensor)

    def seeds(self, *parts: int) -> list[int]:
        """Return a seed for each image; that of the first is the seed of the model's image alone."""
        return [scan_seed(*parts, at) if at else scan_seed(*parts) for at in range(self.phases)]

    def beside_one_another(self, condition: Observed, seeds: list[int]) -> Observed:
        """Return the condition of the images of one scan, told the seeds of the images of the columns before."""
        unknown = len(seeds) - 1
        earlier = [[*[-1] * (unknown - at), *seeds[:at]] for at in range(len(seeds))]
        return replace(condition, earlier_seeds=torch.tensor(earlier, dtype=torch.int64)) if unknown else condition


def phase_seed(seed: int, phase: int) -> int:
    """Return the seed of what is random about the observed pixels of one image, the first as if it were alone."""
    return derive_seed(seed, phase) if phase else seed


def columns_fired(scan: Scan) -> tuple[int, float | None]:
    """Return in about how many columns the sensor of a scan fires, and the azimuth at which the first of them begins.

    The number is a turn over the usual step of azimuth between neighbours of a ring; 0 where rings are not known, or
    hold few points. The azimuth puts firings in the middle of columns; None where they lie anywhere in these.
    """
    scan = scan.measured()
    ring = known_rings(scan)
    if ring is None:
        return 0, None
    x, y = scan.points_xyz_m.double().numpy()[:, :2].T
    azimuth_rad = np.arctan2(y, x)
    order = np.lexsort((azimuth_rad, ring))
    steps_rad, change = np.diff(azimuth_rad[order]), np.diff(ring[order])
    steps_rad = steps_rad[(change == 0) & (steps_rad > _ONE_RAY_RAD)]
    if len(steps_rad) < _STEPS_AT_LEAST:
        return 0, None
    columns = round(2 * math.pi / float(np.median(steps_rad)))
    where = complex(np.exp(1j * columns * azimuth_rad).mean())
    if abs(where) < _IN_COLUMNS:
        return columns, None
    return columns, math.pi + float(np.angle(-where * np.exp(-1j * columns * math.pi))) / columns
