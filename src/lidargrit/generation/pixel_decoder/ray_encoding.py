"""What networks are told of a sensor's rays: a sensor and a lattice → values of every row, for any number of rows."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lidargrit.core.errors import ConfigError
from lidargrit.generation.pixel_decoder.pixel_phases import Lattice
from lidargrit.scans.sensors import SensorModel, SensorSetup

_CYCLES = (2, 4, 8, 16, 32, 64)  # a radian: from the whole field to half a degree
_HIDDEN = 32
_ROWS_AT_ONCE = 16  # rows of an image are a multiple of it; absent ones fill it up
LEAST_CELL = 8
_ABSENT_APART_RAD = 1e-3
_TYPICAL_STEP_RAD, _TYPICAL_HEIGHT_M, _TYPICAL_LIMITS_M = math.radians(0.5), 1.8, (1.0, 100.0)


_ROWS, _COLUMNS = (8, 128), (256, 2048)
_ELEVATION_DEG, _APART_DEG = (-35.5, 25.5), (0.02, 10.0)
_NEAREST_M, _FARTHEST_M, _HEIGHT_M = (0.0, 3.0), (20.0, 250.0), (1.0, 3.0)


def check_bounds(sensor: SensorModel) -> None:
    """Refuse a sensor beyond those of :mod:`lidargrit.scans.drawn_sensors`, on which networks for any are trained."""
    elevation_deg = sensor.elevation_rad.mean(1) * (180 / math.pi)
    apart_deg = -elevation_deg.diff() if sensor.height > 1 else elevation_deg.new_full((1,), _APART_DEG[0])
    height_m = sensor.setup.height_m if sensor.setup else _TYPICAL_HEIGHT_M
    for what, low, high, bounds in (
        ("rows", sensor.height, sensor.height, _ROWS),
        ("columns", sensor.width, sensor.width, _COLUMNS),
        ("degrees of elevation", float(elevation_deg.min()), float(elevation_deg.max()), _ELEVATION_DEG),
        ("degrees between rows", float(apart_deg.min()), float(apart_deg.max()), _APART_DEG),
        ("m of shortest range", sensor.range_min_m, sensor.range_min_m, _NEAREST_M),
        ("m of longest range", sensor.range_max_m, sensor.range_max_m, _FARTHEST_M),
        ("m above the road", height_m, height_m, _HEIGHT_M),
    ):
        if not bounds[0] <= low <= high <= bounds[1]:
            found = f"{low:g}" if low == high else f"{low:.3g} to {high:.3g}"
            cure = "choose columns, as --set data.columns=1024" if what == "columns" else "train a model of its own"
            got = f"the sensor {sensor.name!r} with {found} {what}"
            raise ConfigError(got, f"{bounds[0]:g} to {bounds[1]:g} {what}, as in training", cure)


def with_absent_rows(sensor: SensorModel) -> SensorModel:
    """Return a sensor with as many rows below its own that the number of all is a multiple of 16."""
    absent = -sensor.height % _ROWS_AT_ONCE
    if not absent:
        return sensor
    azimuth, setup = sensor.azimuth_rad, sensor.setup and SensorSetup(height_m=sensor.setup.height_m)
    if len(azimuth) > 1:
        azimuth = torch.cat((azimuth, azimuth[-1:].expand(absent, -1)))
    with torch.device("cpu"):  # where sensors are, also where networks are made without values
        below = sensor.elevation_rad[-1:] - _ABSENT_APART_RAD * torch.arange(1, absent + 1)[:, None]
        elevation = torch.cat((sensor.elevation_rad, below))
        return replace(sensor, elevation_rad=elevation, azimuth_rad=azimuth, azimuth_offset_rad=None, setup=setup)


def coarsest_cell_of(sensor: SensorModel, at_most: int) -> int:
    """Return the side of the largest cells, a power of 2, that divide both sides of a sensor's image.

    Args:
        at_most: largest side.
    """
    cell = math.gcd(sensor.height, sensor.width, at_most)
    if cell < min(LEAST_CELL, at_most):
        got = f"the sensor {sensor.name!r} of {sensor.width} columns"
        cure = "choose them with --set data.columns=1024" if sensor.width > 1024 else "choose other columns"
        raise ConfigError(got, f"a multiple of {LEAST_CELL} columns", cure)
    return cell


class RowEncoding(nn.Module):
    """Values of every row of a sensor, which a small perceptron computes from the angles of its rays.

    They stand in place of values that are learned row by row, so that weights fit every sensor. A lattice's rows are
    told how far apart they are there, in radians.

    Args:
        channels: number of values of a row.
        sensor: sensor of the images; the first ``rows`` rows are its own, the others absent.
    """

    def __init__(self, channels: int, sensor: SensorModel, rows: int, lattices: Sequence[Lattice]) -> None:
        super().__init__()
        for lattice in lattices:
            features = row_features(sensor, rows, lattice)
            self.register_buffer(f"features_{lattice.name}", features, persistent=False)
        inputs = self.get_buffer(f"features_{lattices[0].name}").shape[1]
        self.network = nn.Sequential(nn.Linear(inputs, _HIDDEN), nn.SiLU(), nn.Linear(_HIDDEN, channels))

    def forward(self, lattice: Lattice) -> Float[Tensor, "C H"]:
        """Return the values of all rows of the image, as networks of a lattice see them."""
        return self.network(self.get_buffer(f"features_{lattice.name}")).T


def row_features(sensor: SensorModel, rows: int, lattice: Lattice) -> Float[Tensor, "H F"]:
    """Return what a perceptron is told of every row: 0 for absent ones but for a last number, which marks them.

    These are the elevation, its sine, its Fourier features, the logarithms of the distances to the rows above and below
    and to the next column of the lattice, whether there are such rows, the height above the road and whether it is
    known, and the logarithms of the limits of range.

    Args:
        rows: number of the sensor's own rows; the rest are absent.
    """
    elevation = sensor.elevation_rad.double().mean(1)[:rows]
    index, apart = torch.arange(rows, device=elevation.device), lattice.rows
    has_above, has_below = index >= apart, index + apart < rows
    usual = apart * (elevation[0] - elevation[-1]) / max(rows - 1, 1)
    above = torch.where(has_above, elevation[(index - apart).clamp(min=0)] - elevation, 0.0)
    below = torch.where(has_below, elevation - elevation[(index + apart).clamp(max=rows - 1)], 0.0)
    above, below = (torch.where(there > 0, there, other) for there, other in ((above, below), (below, above)))
    steps = [torch.where(step > 0, step, usual.clamp(min=1e-4)) for step in (above, below)]
    steps.append(torch.full_like(elevation, lattice.columns * 2 * math.pi / sensor.width))
    alike = [sensor.setup.height_m - _TYPICAL_HEIGHT_M, 1.0] if sensor.setup else [0.0, 0.0]
    limits = zip((sensor.range_min_m, sensor.range_max_m), _TYPICAL_LIMITS_M, strict=True)
    alike += [math.log(limit / typical) / 2 for limit, typical in limits]
    angles = [wave(cycles * elevation) for cycles in _CYCLES for wave in (torch.sin, torch.cos)]
    columns = [2 * elevation, 2 * elevation.sin(), *angles, *((step / _TYPICAL_STEP_RAD).log() / 2 for step in steps)]
    columns += [has_above.double(), has_below.double(), *(torch.full_like(elevation, one) for one in alike)]
    told = torch.stack([*columns, torch.zeros_like(elevation)], 1)
    absent = told.new_zeros(sensor.height - rows, told.shape[1])
    absent[:, -1] = 1
    return torch.cat((told, absent)).float()
