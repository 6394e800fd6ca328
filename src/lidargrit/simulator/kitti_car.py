"""Facts about the car that recorded KITTI: which rays end on it."""

import numpy as np
from jaxtyping import Bool, Float

SENSORS_ON_CAR = ("hdl64e_kitti_360", "hdl64e_kitti_odometry")

# Measured in 67 scans of KITTI, which docs/results/simulator-against-kitti.md names: azimuths, in whole degrees, at
# which fewer than half of them return anything. One line a laser, by its elevation in degrees. No two lasers see the
# same rim: they look past the roof's edge from different places.
# fmt: off
_HIDDEN_DEG = (
    (-13.14, ((-161, -153), (158, 166))),
    (-13.65, ((-164, -155), (155, 163))),
    (-14.23, ((-162, -153), (157, 166))),
    (-14.67, ((-165, -156), (155, 163))),
    (-15.16, ((-161, -154), (-63, -60), (158, 165))),
    (-15.52, ((-163, -157), (-74, -64), (155, 162))),
    (-16.14, ((-161, -155), (-75, -56), (160, 166))),
    (-16.66, ((-164, -158), (-81, -62), (158, 164))),
    (-17.22, ((-162, -157), (-77, -56), (161, 166))),
    (-17.67, ((-164, -160), (-83, -61), (159, 163))),
    (-18.17, ((-162, -157), (-79, -56), (160, 165), (169, 194))),
    (-18.57, ((-84, -61), (157, 201))),
    (-19.02, ((-78, -54), (160, 205))),
    (-19.57, ((-130, -128), (-81, -60), (127, 131), (157, 203))),
    (-20.08, ((-129, -123), (-78, -56), (130, 136), (158, 206))),
    (-20.67, ((-134, -126), (-82, -61), (-11, 11), (126, 134), (154, 205))),
    (-21.16, ((-131, -122), (-78, -56), (-14, 15), (128, 137), (155, 208))),
    (-21.56, ((-135, -126), (-83, -65), (-16, 16), (125, 134), (152, 207))),
    (-22.00, ((-131, -121), (-76, -61), (-36, -33), (-29, -24), (-16, 18), (30, 32), (129, 139), (154, 211))),
    (-22.64, ((-140, -139), (-134, -125), (-81, -69), (-39, -34), (-32, -28), (-18, 19), (26, 30), (34, 38),
              (126, 135), (136, 141), (151, 209))),
    (-23.15, ((-138, -134), (-131, -122), (-83, -82), (-76, -67), (-37, -25), (-18, 20), (28, 33), (35, 41),
              (130, 146), (152, 213))),
    (-23.64, ((-144, -126), (-89, -88), (-82, -76), (-40, -28), (-20, 20), (25, 30), (31, 38), (125, 213))),
)
# fmt: on


def hidden_by_car(
    azimuth_rad: Float[np.ndarray, "#H W"], elevation_rad: Float[np.ndarray, "H #W"]
) -> Bool[np.ndarray, "H W"]:
    """Return which rays end on the car that carries the sensor, by the laser of the nearest elevation.

    Args:
        azimuth_rad: azimuth, counter-clockwise from straight ahead.
        elevation_rad: elevation, up positive.
    """
    azimuth, elevation = np.broadcast_arrays(np.degrees(azimuth_rad), np.degrees(elevation_rad))
    lasers = np.array([laser for laser, _ in _HIDDEN_DEG])
    borders = (lasers[1:] + lasers[:-1]) / 2
    highest = lasers[0] + (lasers[0] - lasers[1]) / 2
    line = np.searchsorted(-borders, -elevation)
    hidden = np.zeros(azimuth.shape, dtype=bool)
    for at, (_, spans) in enumerate(_HIDDEN_DEG):
        own = (line == at) & (elevation < highest)
        for first, last in spans:
            hidden |= own & ((azimuth - first) % 360 < last - first)
    return hidden
