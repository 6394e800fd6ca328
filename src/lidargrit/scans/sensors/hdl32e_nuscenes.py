"""HDL-32E as the nuScenes literature images it: 32 equal rows from +10 to -30 degrees, 1024 columns, 1.45 to 80 m."""

import math

import torch

from lidargrit.scans.sensors import SensorModel, column_azimuths_rad

_TOP_DEG, _BOTTOM_DEG, _ROWS = 10.0, -30.0, 32
_centres_deg = _TOP_DEG - (_TOP_DEG - _BOTTOM_DEG) * (torch.arange(_ROWS, dtype=torch.float64) + 0.5) / _ROWS

HDL32E_NUSCENES = SensorModel(
    name="hdl32e_nuscenes",
    elevation_rad=(_centres_deg * (math.pi / 180)).float()[:, None],
    azimuth_rad=column_azimuths_rad(1024),
    range_min_m=1.45,
    range_max_m=80.0,
    projection="spherical",
    source="field of view and limits: LiDARCrafter (worldbench/lidarcrafter@3c62da2); rows here are the centres of its "
    "bins of 1.25 degrees. The lasers lie 4/3 degrees apart from +10.67 to -30.67: the first and the last lie outside "
    "the field, and those at 0 and -20 degrees on the border of two rows, of which noise decides",
)
