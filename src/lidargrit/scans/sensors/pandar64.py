"""Hesai Pandar64: 64 rows from +14.88 to -24.90 degrees, 0.17 apart near level, 1800 columns, 0.3 to 200 m."""

import math

import torch

from lidargrit.scans.sensors import SensorModel, column_azimuths_rad

# Degrees, top laser first.
# fmt: off
_ELEVATION_DEG = (
    14.882, 11.032, 8.059, 5.057, 3.040, 2.028, 1.860, 1.688,
    1.522, 1.351, 1.184, 1.013, 0.846, 0.675, 0.508, 0.337,
    0.169, 0.000, -0.169, -0.337, -0.508, -0.675, -0.845, -1.013,
    -1.184, -1.351, -1.522, -1.688, -1.860, -2.028, -2.198, -2.365,
    -2.536, -2.700, -2.873, -3.040, -3.210, -3.375, -3.548, -3.712,
    -3.884, -4.050, -4.221, -4.385, -4.558, -4.720, -4.892, -5.057,
    -5.229, -5.391, -5.565, -5.726, -5.898, -6.061, -7.063, -8.059,
    -9.060, -9.885, -11.032, -12.006, -12.974, -13.930, -18.889, -24.897,
)
# fmt: on
# Six lasers stand side by side where rows are dense; Hesai counts clockwise.
_ASIDE_DEG = (-1.042,) * 6 + (1.042, 3.125, 5.208, -5.208, -3.125, -1.042) * 8 + (-1.042,) * 10

PANDAR64 = SensorModel(
    name="pandar64",
    elevation_rad=(torch.tensor(_ELEVATION_DEG, dtype=torch.float64) * (math.pi / 180)).float()[:, None],
    azimuth_rad=column_azimuths_rad(1800),
    range_min_m=0.3,
    range_max_m=200.0,
    projection="spherical",
    source="angles: default tables (pandarGeneral_elev_angle_map and its azimuth offsets) of "
    "HesaiTechnology/HesaiLidar_General_SDK@00c6a01; columns: 0.2 degrees, 10 turns a second; limits: as usually "
    "quoted for it, at 10 % reflectivity; the manual itself was not at hand",
    azimuth_offset_rad=-(torch.tensor(_ASIDE_DEG, dtype=torch.float64) * (math.pi / 180)).float(),
)
