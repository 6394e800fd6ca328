"""VLP-16: 16 equal rows from +15 to -15 degrees, 1800 columns (10 turns a second), 0.9 to 100 m."""

import math

import torch

from lidargrit.scans.sensors import SensorModel, column_azimuths_rad

_elevation_deg = 15 - 2 * torch.arange(16, dtype=torch.float64)

VLP16 = SensorModel(
    name="vlp16",
    elevation_rad=(_elevation_deg * (math.pi / 180)).float()[:, None],
    azimuth_rad=column_azimuths_rad(1800),
    range_min_m=0.9,
    range_max_m=100.0,
    projection="spherical",
    source="elevations: params/VLP16db.yaml of ros-drivers/velodyne@3353568, which has no azimuth offsets; its lasers "
    "sit up to 11 mm above and below the middle, which is left out here; columns: 0.2 degrees, 10 turns a second "
    "(a firing every 55.296 us makes it 1808); near limit: ros-drivers/velodyne@d7f4697; far limit: as usually "
    "quoted for it; the manual's own page was not at hand",
)
