"""HDL-32E: 32 equal rows from +10.67 to -30.67 degrees, 1084 columns (20 turns a second), 1 to 100 m."""

import math

import torch

from lidargrit.scans.sensors import SensorModel, column_azimuths_rad

_TOP_DEG, _STEP_DEG, _ROWS = 32 / 3, 4 / 3, 32  # the manual rounds them to 0.01 degrees
_elevation_deg = _TOP_DEG - _STEP_DEG * torch.arange(_ROWS, dtype=torch.float64)

HDL32E = SensorModel(
    name="hdl32e",
    elevation_rad=(_elevation_deg * (math.pi / 180)).float()[:, None],
    azimuth_rad=column_azimuths_rad(1084),
    range_min_m=1.0,
    range_max_m=100.0,
    projection="unfolding",
    source="elevations: table of the firing sequence in Velodyne's HDL-32E user's manual, the same as params/32db.yaml "
    "of ros-drivers/velodyne@4c5309f, which has no azimuth offsets; columns: a file of nuScenes holds 1084 to 1086 "
    "firings (50 ms / 46.08 us = 1085); far limit: the manual's 100 m; near limit: nearer returns are the car that "
    "carries it (the manual has 5 cm, and the tools of nuScenes leave out what is nearer than 1 m)",
)
