"""Ouster OS1-64 as it was designed: 64 equal rows from +16.61 to -16.61 degrees, 1024 columns, 0.8 to 120 m."""

import math

import torch

from lidargrit.scans.sensors import SensorModel, column_azimuths_rad

_TOP_DEG, _ROWS = 16.611, 64
_STEP_DEG = 2 * _TOP_DEG / (_ROWS - 1)
_elevation_deg = _TOP_DEG - _STEP_DEG * torch.arange(_ROWS, dtype=torch.float64)
_ASIDE_DEG = (3.164, 1.055, -1.055, -3.164)  # by turns from the top; clockwise is positive in Ouster's tables
_FIRST_EDGE_RAD = math.pi + math.pi / 1024  # it fires at whole multiples of a column

OS1_64 = SensorModel(
    name="os1_64",
    elevation_rad=(_elevation_deg * (math.pi / 180)).float()[:, None],
    azimuth_rad=column_azimuths_rad(1024, first_edge_rad=_FIRST_EDGE_RAD),
    range_min_m=0.8,
    range_max_m=120.0,
    projection="spherical",
    source="angles: the default tables of the first generation (gen1_altitude_angles, gen1_azimuth_angles) of "
    "ouster-lidar/ouster-sdk; those of one unit, in its metadata, differ by up to half a degree: lidargrit fit-sensor "
    "finds them; columns: mode 1024x10; limits: Ouster's OS1 datasheet, at 80 % reflectivity",
    first_edge_rad=_FIRST_EDGE_RAD,
    azimuth_offset_rad=-(torch.tensor(_ASIDE_DEG, dtype=torch.float64) * (math.pi / 180)).repeat(_ROWS // 4).float(),
)
