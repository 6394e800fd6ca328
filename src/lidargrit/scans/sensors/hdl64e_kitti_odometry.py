"""HDL-64E of KITTI as its scans unfold: two blocks of 32 unequal rows, every 8th of 2048 columns, 0.9 to 120 m.

The 32 upper lasers are about 1/3 degree apart, the 32 lower ones about 1/2: rows are not linear in elevation.
The azimuth offsets of KITTI's own unit are not published.
"""

import math

import torch

from lidargrit.scans.sensors import SensorModel, column_azimuths_rad

# Degrees, top ring first. Two laser blocks: steps of about 1/3 degree above -8, of about 1/2 degree below.
# fmt: off
_RING_ELEVATION_DEG = (
    2.60, 2.23, 1.99, 1.53, 1.27, 0.86, 0.60, 0.23,
    -0.12, -0.53, -0.83, -1.17, -1.55, -1.87, -2.17, -2.53,
    -2.83, -3.22, -3.51, -3.88, -4.19, -4.54, -4.84, -5.17,
    -5.54, -5.86, -6.17, -6.44, -6.81, -7.17, -7.39, -7.77,
    -8.38, -8.90, -9.36, -9.75, -10.21, -10.81, -11.30, -11.73,
    -12.18, -12.60, -13.14, -13.65, -14.23, -14.67, -15.16, -15.52,
    -16.14, -16.66, -17.22, -17.67, -18.17, -18.57, -19.02, -19.57,
    -20.08, -20.67, -21.16, -21.56, -22.00, -22.64, -23.15, -23.64,
)
# fmt: on

HDL64E_KITTI_ODOMETRY = SensorModel(
    name="hdl64e_kitti_odometry",
    elevation_rad=(torch.tensor(_RING_ELEVATION_DEG, dtype=torch.float64) * (math.pi / 180)).float()[:, None],
    azimuth_rad=column_azimuths_rad(2048, stride=8),
    range_min_m=0.9,
    range_max_m=120.0,
    projection="unfolding",
    column_stride=8,
    source="elevations: median over 45 unfolded scans of KITTI odometry 00 and one KITTI raw drive of 2011-09-26 "
    "(the two differ by up to 0.2 degrees in the upper block, whose lasers sit above the origin); "
    "width and limits: LidarGRIT (hamedhaghighi/LidarGRIT@a3f86e7)",
)
