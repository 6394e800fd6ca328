"""VLP-32C (Ultra Puck): 32 rows from +15 to -25 degrees, dense near level, 1800 columns, 0.9 to 200 m."""

import math

import torch

from lidargrit.scans.sensors import SensorModel, column_azimuths_rad

# Degrees, top laser first; offsets counter-clockwise, the other way round than the manual counts azimuth.
# fmt: off
_ELEVATION_DEG = (
    15.000, 10.333, 7.000, 4.667, 3.333, 2.333, 1.667, 1.333,
    1.000, 0.667, 0.333, 0.000, -0.333, -0.667, -1.000, -1.333,
    -1.667, -2.000, -2.333, -2.667, -3.000, -3.333, -3.667, -4.000,
    -4.667, -5.333, -6.148, -7.254, -8.843, -11.310, -15.639, -25.000,
)
_AZIMUTH_OFFSET_DEG = (
    1.4, -1.4, 1.4, -1.4, 1.4, -1.4, 4.2, 1.4,
    -1.4, -4.2, 4.2, 1.4, -1.4, -4.2, 4.2, 1.4,
    -1.4, -4.2, 4.2, 1.4, -1.4, -4.2, 4.2, 1.4,
    -1.4, -4.2, 1.4, -1.4, 1.4, -1.4, 1.4, -1.4,
)
# fmt: on

VLP32C = SensorModel(
    name="vlp32c",
    elevation_rad=(torch.tensor(_ELEVATION_DEG, dtype=torch.float64) * (math.pi / 180)).float()[:, None],
    azimuth_rad=column_azimuths_rad(1800),
    range_min_m=0.9,
    range_max_m=200.0,
    projection="spherical",
    source="elevations: Velodyne's VLP-32C user manual, 63-9325, table 9-6; azimuth offsets of each laser: "
    "src/calib_db.cpp of valgur/velodyne_decoder@3ac16b8 (the manual's four columns of +-1.4 and +-4.2 degrees); "
    "columns: 0.2 degrees, 10 turns a second; near limit: ros-drivers/velodyne@5caeebf; far limit: as "
    "usually quoted for it; the manual's own page was not at hand",
    azimuth_offset_rad=(torch.tensor(_AZIMUTH_OFFSET_DEG, dtype=torch.float64) * (math.pi / 180)).float(),
)
