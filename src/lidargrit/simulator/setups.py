"""Set-ups of sensors of which there are scans: a sensor and a random stream → what its unit adds to the streets."""

from dataclasses import replace
from typing import Final

import numpy as np

from lidargrit.scans.sensors import SensorModel, SensorSetup

# Of KITTI's HDL-64E, a row is a laser, from the top.
# Offsets: means of two drives, which correlate by .91, of planes' residuals (scans.surface_patches); a third drive,
# which was not used, correlates by .73. Gains and readings: fitted by benchmarks/fit_raydrop.py to the shares of
# returns and the reflectances of the rows of 67 scans, in simulated streets; the weak ones read dark on any road.
# fmt: off
_OFFSET_M = (
    0.030, -0.005, 0.040, -0.024, 0.024, -0.086, 0.056, -0.020,
    -0.019, 0.004, 0.045, 0.000, 0.030, -0.004, -0.026, -0.037,
    0.031, -0.012, 0.064, -0.012, 0.003, -0.040, -0.027, -0.033,
    0.026, -0.023, 0.016, -0.039, 0.048, 0.002, 0.008, 0.028,
    -0.036, -0.017, -0.024, -0.001, 0.004, -0.051, 0.036, 0.034,
    0.010, 0.045, -0.025, -0.035, 0.038, -0.015, -0.024, -0.036,
    0.005, 0.035, -0.009, -0.024, 0.012, 0.032, -0.022, -0.004,
    -0.004, -0.001, 0.006, -0.019, -0.031, 0.008, 0.024, 0.041,
)
_LOG_GAIN = (
    0.1, 0.3, -0.5, -0.5, -0.7, 0.1, 0.0, 0.1, 0.3, -0.2, 0.3, 0.6, 0.5, 0.3, 0.2, -0.3,
    0.3, 0.3, 0.6, 0.1, 0.8, -0.7, 0.5, 0.7, -0.1, 0.2, 0.4, 0.3, 0.1, -0.5, 0.0, -0.1,
    0.5, -0.4, 0.0, -1.4, -1.6, -0.5, 0.2, -0.7, -0.8, -0.5, -1.8, -0.8, -0.9, -0.9, -1.0, -1.3,
    -1.6, -1.1, -1.2, -2.4, -1.3, -1.8, -2.1, -1.4, -1.4, -1.6, -2.2, -2.2, -2.4, -1.7, -1.8, -1.9,
)
_READING = (
    1.0, 0.9, 0.85, 0.8, 1.0, 0.85, 1.0, 0.9, 1.0, 0.8, 0.9, 1.0, 1.15, 1.0, 0.9, 0.9,
    0.95, 0.9, 1.05, 0.9, 1.0, 0.75, 1.0, 1.0, 0.9, 0.95, 1.0, 1.0, 1.0, 0.85, 1.0, 1.0,
    0.95, 0.95, 0.95, 0.85, 0.75, 0.95, 1.15, 1.1, 0.9, 0.95, 0.75, 1.0, 1.0, 1.0, 1.0, 0.9,
    0.85, 1.05, 1.15, 0.7, 0.95, 0.85, 0.85, 0.95, 1.0, 1.15, 0.85, 0.85, 0.85, 1.05, 1.2, 1.1,
)
# fmt: on
_KITTI = SensorSetup(
    # Measured along the rows of odometry 00 and of the raw drive 9005 (scans.surface_patches): .7 cm near, 1.4 at 23 m.
    range_sigma_m=0.0073,
    range_sigma_per_m=0.0005,
    footprint_sigma=0.03,  # by which ground at 85 degrees is noisier than walls
    firing_jitter_rad=0.000719475,  # of 2,048 columns; of four unfolded scans 2.9 to 3.5 % of the pixels have no firing
    farthest_m=80.0,  # of the files, not of the sensor, which sees to 120 m
    divergence_mrad=2.0,  # data sheet of the HDL-64E S2
    pulse_length_m=0.75,  # pulses of 5 ns, by the same data sheet, so c t / 2
    fades_from_m=18.0,  # walls and leaves of four sets of KITTI's scans read alike to there, half as bright at 40 m
    fades_to_m=60.0,  # four in five returns beyond read 0
    split_exponent=6.0,  # so that as many depth jumps have a drop
    height_m=1.77,  # median of 16 labelled scans of odometry 00
)
_HDL64E_OF_ODOMETRY = replace(_KITTI, offset_m=_OFFSET_M, log_gain=_LOG_GAIN, reading=_READING)
# What fit-sensor tells of seven frames of PandaSet, whose surfaces have hardly a drop; its lasers read nearly alike.
# Labelled points there do not grow darker with range: medians of road .03 at 5 m and at 60. Leaves and walls read
# thrice as bright as road, in KITTI 1.5 times: hence the power. Both are fitted by class to the drive 001.
# Windows of its cars return from the pane, or from within, and are hardly ever missing: set by eye beside 001 and 002.
_PANDAR64 = SensorSetup(
    range_sigma_m=0.01,
    glass_scatters=40.0,
    reflectance_scale=0.57,
    reflectance_power=2.5,
    weak_dimming=0.0,
    height_m=2.08,
)
PACKAGED: Final = {"hdl64e_kitti_odometry": _HDL64E_OF_ODOMETRY, "hdl64e_kitti_360": _KITTI, "pandar64": _PANDAR64}
"""Set-up of each packaged sensor of which there are scans; in KITTI-360's images several lasers meet in one row."""


def setup_of(sensor: SensorModel, rng: np.random.Generator) -> SensorSetup:
    """Return the set-up of a sensor: its own, that of the packaged sensor of its name and rows, or a sampled one.

    Args:
        rng: source of a unit of which there are no scans.
    """
    if sensor.setup is not None:
        return sensor.setup
    packaged = PACKAGED.get(sensor.name)
    if packaged is not None and len(packaged.offset_m) in (0, sensor.height):
        return packaged
    return SensorSetup.sample(rng, sensor.height)
