"""HDL-64E as the KITTI-360 literature images it: 64 equal rows from +3 to -25 degrees, 1024 columns, 1.45 to 80 m."""

import math

import torch

from lidargrit.scans.sensors import SensorModel, column_azimuths_rad

_TOP_DEG, _BOTTOM_DEG, _ROWS = 3.0, -25.0, 64
_centres_deg = _TOP_DEG - (_TOP_DEG - _BOTTOM_DEG) * (torch.arange(_ROWS, dtype=torch.float64) + 0.5) / _ROWS

HDL64E_KITTI_360 = SensorModel(
    name="hdl64e_kitti_360",
    elevation_rad=(_centres_deg * (math.pi / 180)).float()[:, None],
    azimuth_rad=column_azimuths_rad(1024),
    range_min_m=1.45,
    range_max_m=80.0,
    projection="spherical",
    source="field of view and limits: LidarGRIT (hamedhaghighi/LidarGRIT@a3f86e7), R2DM (kazuto1011/r2dm@ad66e71); "
    "rows here are the centres of the bins, which those programs round to or unproject at the edge",
)
