"""Ouster OS1-128, one unit's own table: 128 rows from +20.95 to -21.82 degrees, 1024 columns, 0.8 to 120 m."""

import math

import torch

from lidargrit.scans.sensors import SensorModel, column_azimuths_rad

# Degrees, top laser first.
# fmt: off
_ELEVATION_DEG = (
    20.95, 20.67, 20.36, 20.03, 19.73, 19.41, 19.11, 18.76,
    18.47, 18.14, 17.82, 17.50, 17.19, 16.86, 16.53, 16.20,
    15.89, 15.56, 15.23, 14.90, 14.57, 14.23, 13.90, 13.57,
    13.25, 12.91, 12.57, 12.22, 11.90, 11.55, 11.20, 10.87,
    10.54, 10.18, 9.84, 9.51, 9.15, 8.81, 8.47, 8.11,
    7.78, 7.43, 7.08, 6.74, 6.39, 6.04, 5.70, 5.34,
    4.98, 4.64, 4.29, 3.93, 3.58, 3.24, 2.88, 2.53,
    2.17, 1.82, 1.47, 1.12, 0.78, 0.41, 0.07, -0.28,
    -0.64, -0.99, -1.35, -1.70, -2.07, -2.40, -2.75, -3.11,
    -3.46, -3.81, -4.15, -4.50, -4.86, -5.22, -5.57, -5.90,
    -6.27, -6.61, -6.97, -7.30, -7.67, -8.01, -8.35, -8.69,
    -9.05, -9.38, -9.71, -10.07, -10.42, -10.76, -11.09, -11.43,
    -11.78, -12.12, -12.46, -12.78, -13.15, -13.46, -13.80, -14.12,
    -14.48, -14.79, -15.11, -15.46, -15.79, -16.12, -16.45, -16.76,
    -17.11, -17.44, -17.74, -18.06, -18.39, -18.72, -19.02, -19.32,
    -19.67, -19.99, -20.27, -20.57, -20.92, -21.22, -21.54, -21.82,
)
# fmt: on
_ASIDE_DEG = (4.21, 1.41, -1.40, -4.21)  # by turns from the top, medians; clockwise is positive in Ouster's tables
_FIRST_EDGE_RAD = math.pi + math.pi / 1024  # it fires at whole multiples of a column

OS1_128 = SensorModel(
    name="os1_128",
    elevation_rad=(torch.tensor(_ELEVATION_DEG, dtype=torch.float64) * (math.pi / 180)).float()[:, None],
    azimuth_rad=column_azimuths_rad(1024, first_edge_rad=_FIRST_EDGE_RAD),
    range_min_m=0.8,
    range_max_m=120.0,
    projection="spherical",
    source="angles: metadata of the OS-1-128 unit 122201000998, firmware 2.3.0, as recorded with a public sample of "
    "Ouster's (its azimuths scatter by 0.03 degrees around these four); other units differ, and lidargrit fit-sensor "
    "finds theirs; columns: mode 1024x10; limits: Ouster's OS1 datasheet, at 80 % reflectivity",
    first_edge_rad=_FIRST_EDGE_RAD,
    azimuth_offset_rad=-(torch.tensor(_ASIDE_DEG, dtype=torch.float64) * (math.pi / 180)).repeat(32).float(),
)
