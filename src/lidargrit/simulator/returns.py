"""Which beams come back: hits of rays → noisy ranges, the return mask and the reflectance, by received power."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Num

from lidargrit.simulator.raycast import PAVEMENT, ROAD, SKY, Hits, Rays
from lidargrit.simulator.solids import Surface
from lidargrit.simulator.street import SENSOR_HEIGHT_M, Street

_GROUND = {  # in the order of ROAD, PAVEMENT, SKY: a table is read with these, negative, from its end
    ROAD: Surface(0.26),
    PAVEMENT: Surface(0.34),
    SKY: Surface(0.0),
}
_GLASS = Surface(2e-5, gloss=8e-4)  # lets the beam through; only a pane struck squarely answers
_INSIDE = 40.0  # how much more the inside of a light car answers through the glass than that of a dark one
_LOBE_POWER = 40  # the mirror-like lobe has fallen to a third at 13 degrees
_NEAR_M = 12.0  # nearer than this the receiver is out of focus, and power no longer grows as 1 / range^2
_LEAST_POWER = 2.5e-6  # asphalt, so grazed, is lost at about 55 m, as in KITTI
_LASER_SPREAD = 0.25  # natural log of the gain, from laser to laser
_PATCH_SPREAD, _PATCH_COLUMNS = 0.5, 16  # the surface's own variation, and how far along a ring it stays alike
_PULSE_SPREAD = 0.12  # from pulse to pulse
_RANGE_SIGMA_M = 0.02  # HDL-64E S2 manual: "< 2 cm accuracy", one sigma
_GAP_SHARE = 0.033  # pixels into which no firing falls: lone gaps, 2.9 to 3.5 % of four unfolded KITTI scans

# The car under the sensor hides the road: azimuth and elevation of the middle, and half extents, in degrees, in round
# numbers as the empty patches that all KITTI scans share.
_CARRIER_DEG = (
    (180, -25, 22, 7.5),
    (161, -15.5, 6, 2.6),
    (-160, -15.5, 6, 2.6),
    (133, -25, 12, 5),
    (0, -25, 23, 5.2),
    (35, -25, 10, 2.6),
    (-68, -18, 13, 3),
    (-128, -25, 9, 3.3),
)


@dataclass(frozen=True, eq=False)
class Chances:
    """All that is random about the beams of one scan, drawn for every column that the sensor fires.

    Args:
        free_path: way into leaves, exponentially distributed with mean 1.
        log_gain: natural log of the power's random factor; alike along a ring.
        range_noise_m: added to every range.
        fired: False where no firing fell into a pixel.
    """

    free_path: Float32[np.ndarray, "H W"]
    log_gain: Float32[np.ndarray, "H W"]
    range_noise_m: Float32[np.ndarray, "H W"]
    fired: Bool[np.ndarray, "H W"]

    @classmethod
    def draw(cls, rng: np.random.Generator, height: int, width: int) -> Chances:
        """Draw the chances of a scan of one size."""
        lasers = np.random.default_rng(64).normal(0, _LASER_SPREAD, (height, 1))  # the same sensor in every scan
        knots = rng.standard_normal((height, width // _PATCH_COLUMNS + 2), dtype=np.float32) * _PATCH_SPREAD
        place = np.arange(width, dtype=np.float32) / _PATCH_COLUMNS
        left = place.astype(int)
        share = place - left.astype(np.float32)
        patches = knots[:, left] * (1 - share) + knots[:, left + 1] * share
        pulses = rng.standard_normal((height, width), dtype=np.float32) * np.float32(_PULSE_SPREAD)
        return cls(
            free_path=rng.standard_exponential((height, width), dtype=np.float32),
            log_gain=lasers.astype(np.float32) + patches + pulses,
            range_noise_m=rng.standard_normal((height, width), dtype=np.float32) * np.float32(_RANGE_SIGMA_M),
            fired=rng.random((height, width), dtype=np.float32) >= _GAP_SHARE,
        )

    def every(self, stride: int) -> Chances:
        """Return the chances of every ``stride``-th column."""
        kept = slice(None, None, stride)
        return Chances(
            self.free_path[:, kept], self.log_gain[:, kept], self.range_noise_m[:, kept], self.fired[:, kept]
        )


def returns(
    street: Street, rays: Rays, hits: Hits, chances: Chances
) -> tuple[Float32[np.ndarray, "H W"], Bool[np.ndarray, "H W"], Float32[np.ndarray, "H W"]]:
    """Decide which beams come back, and measure them.

    Returns:
        range in metres (infinite for the sky), True = a return, and reflectance in [0, 1].
    """
    range_m = hits.way_m / np.cos(rays.elevation_rad).astype(np.float32)
    scattered, mirrored = _answer(street, rays, hits)
    power = received_power(scattered, mirrored, hits.cos_incidence, range_m)
    came_back = power * np.exp(chances.log_gain) > _LEAST_POWER
    came_back &= chances.fired & ~_on_carrier(rays)
    shine = mirrored * hits.cos_incidence**_LOBE_POWER
    reflectance = scattered * (0.6 + 0.4 * hits.cos_incidence) * (1 + 0.3 * chances.log_gain) + 0.5 * shine
    reflectance = np.round(np.clip(reflectance, 0, 0.99), 2)  # KITTI's files hold hundredths
    return range_m + chances.range_noise_m, came_back, reflectance.astype(np.float32)


def received_power(
    albedo: Float32[np.ndarray, "*shape"],
    gloss: Float32[np.ndarray, "*shape"],
    cos_incidence: Float32[np.ndarray, "*shape"],
    range_m: Float32[np.ndarray, "*shape"],
) -> Float32[np.ndarray, "*shape"]:
    """Return the power that comes back from a surface, in units of a white one at 1 m in focus; 0 from the sky.

    Lambert's law with a glossy lobe, over the square of the range. The overlap of beam and receiver, which
    HDL-64E lacks close by, is written as an added constant.

    Source:
        Wagner et al., ISPRS J. 60(2), 2006, eq. 4 (the lidar equation for an extended target).
    """
    return (albedo * cos_incidence + gloss * cos_incidence**_LOBE_POWER) / (range_m**2 + np.float32(_NEAR_M**2))


def _answer(street: Street, rays: Rays, hits: Hits) -> tuple[Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W"]]:
    """Return albedo and gloss at every hit, glass where there is a window."""
    surfaces = [solid.surface for solid in street.solids] + list(_GROUND.values())
    albedo = np.array([s.albedo for s in surfaces], dtype=np.float32)[hits.solid]
    gloss = np.array([s.gloss for s in surfaces], dtype=np.float32)[hits.solid]
    glazed = np.array([s.windows != "none" for s in surfaces])[hits.solid]
    row, column = np.nonzero(glazed)
    glass = _is_glass(street, rays, hits, row, column)
    row, column = row[glass], column[glass]
    albedo[row, column] = _GLASS.albedo * _INSIDE ** _hash(hits.solid[row, column].astype(np.float64))
    gloss[row, column] = _GLASS.gloss
    return albedo, gloss


def _is_glass(
    street: Street, rays: Rays, hits: Hits, row: Int[np.ndarray, " n"], column: Int[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Tell which hits, all on glazed solids, lie on a pane."""
    kinds = {"none": 0, "house": 0, "cabin": 1, "belt": 2}
    table = np.array(
        [
            (s.x_m, s.y_m, s.yaw_rad, s.half_length_m, s.half_width_m, s.top_m, kinds[s.surface.windows])
            for s in street.solids
        ]
    )
    solid = hits.solid[row, column]
    x, y, yaw, half_length, half_width, top, kind = table[solid].T
    azimuth = np.broadcast_to(rays.azimuth_rad, hits.solid.shape)[row, column]
    elevation = np.broadcast_to(rays.elevation_rad, hits.solid.shape)[row, column]
    way = hits.way_m[row, column].astype(np.float64)
    hit_x, hit_y = way * np.cos(azimuth), way * np.sin(azimuth)
    height = way * np.tan(elevation) - street.slope_x * hit_x - street.slope_y * hit_y + SENSOR_HEIGHT_M
    along = np.cos(yaw) * (hit_x - x) + np.sin(yaw) * (hit_y - y)
    across = np.cos(yaw) * (hit_y - y) - np.sin(yaw) * (hit_x - x)
    on_end = np.abs(np.abs(along) - half_length) < np.abs(np.abs(across) - half_width)
    place, half = np.where(on_end, across, along), np.where(on_end, half_width, half_length)
    roof = (height > top - 0.02) & (kind < 2)
    pane = (np.abs(place) < half - 0.07) & (on_end | (np.abs(place) > 0.05))  # pillars at the corners and amidships
    return ~roof & np.where(kind > 0, pane, _house_panes(place, height, solid))


def _house_panes(
    place: Num[np.ndarray, " n"], height: Num[np.ndarray, " n"], solid: Int[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Set windows 1.1 m wide in the storeys of a house; three of four answer by their frame or curtain."""
    spacing = 2.4 + 0.37 * (solid % 5)
    bay, storey = np.floor(place / spacing), np.floor(height / 3.0)
    opening = (np.abs(place - (bay + 0.5) * spacing) < 0.55) & (np.abs(height - storey * 3.0 - 1.6) < 0.65)
    return opening & (_hash(bay, storey, solid) < 1 / 4)


def _hash(*of: Num[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Map numbers to [0, 1), always in the same way and with no order left."""
    mixed = 43758.5453 * np.sin(sum(f * value for f, value in zip((12.9898, 78.233, 37.719), of, strict=False)))
    return mixed - np.floor(mixed)


def _on_carrier(rays: Rays) -> Bool[np.ndarray, "H W"]:
    """Tell which rays end on the car that carries the sensor."""
    azimuth, elevation = np.degrees(rays.azimuth_rad), np.degrees(rays.elevation_rad)
    edge = np.random.default_rng(64).uniform(0.6, 1.1, (len(elevation), 1))  # ragged: no two lasers see the same rim
    hidden = np.zeros(np.broadcast_shapes(azimuth.shape, elevation.shape), dtype=bool)
    for middle, tilt, half_width, half_height in _CARRIER_DEG:
        turn = (azimuth - middle + 180) % 360 - 180
        hidden |= np.abs(turn / half_width) ** 2 + np.abs((elevation - tilt) / half_height) ** 4 < edge
    return hidden
