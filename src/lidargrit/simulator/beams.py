"""Rays of a sensor: a sensor and a random stream → one ray for each pixel, in its frame or a scene's.

A revolution begins straight ahead and goes counter-clockwise, in the firing order of KITTI's files.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float32, Float64

from lidargrit.scans.sensors import SensorModel
from lidargrit.simulator.kitti_car import SENSORS_ON_CAR, hidden_by_car

REVOLUTION_S = 0.1  # KITTI's sensor turns at 10 Hz: Geiger et al., IJRR 2013, section 2


@dataclass(frozen=True, eq=False)
class Beams:
    """One ray for each pixel: rows from the top, columns of falling azimuth.

    Args:
        elevation_rad: elevation of each ray, up positive.
        azimuth_rad: azimuth of each ray, counter-clockwise from +x, within the pixel's own column.
        turn: share of the revolution, 0 to 1, after which the ray is fired.
        fired: False where no firing falls into the pixel.
        clear: False where the ray ends on the car that carries the sensor.
        gap_share: expected share of pixels without a firing, which is 1 less the mean of ``fired``.
    """

    elevation_rad: Float32[np.ndarray, "H #W"]
    azimuth_rad: Float32[np.ndarray, "H W"]
    turn: Float32[np.ndarray, "#H W"]
    fired: Bool[np.ndarray, "H W"]
    clear: Bool[np.ndarray, "H W"]
    gap_share: float

    @classmethod
    def sample(cls, sensor: SensorModel, rng: np.random.Generator, jitter_rad: float) -> "Beams":
        """Aim at every fine column of a sensor, with the small jitter of a turning head.

        A pixel whose ray leaves its column by the jitter gets no firing.

        Args:
            sensor: sensor to simulate; columns that its image leaves out are included.
            jitter_rad: standard deviation of the azimuth at which a laser fires, in radians.
        """
        elevation, azimuth, turn, phase, clear = _aims(sensor)
        step = np.float32(2 * math.pi / clear.shape[1])
        jitter = rng.standard_normal(clear.shape, dtype=np.float32) * (np.float32(jitter_rad) / step)  # in columns
        fired = np.abs(jitter) <= 0.5
        aside = np.clip(jitter + phase, -0.49, 0.49)  # a firing of another pixel is not this one's to place
        sigmas = 0.5 * float(step) / jitter_rad if jitter_rad else math.inf
        return cls(elevation, azimuth - aside * step, turn, fired, clear, math.erfc(sigmas / math.sqrt(2)))

    def columns(self, which: slice) -> "Beams":
        """Return the rays of some columns."""
        shared = self.elevation_rad.shape[1] == 1
        return replace(
            self,
            elevation_rad=self.elevation_rad if shared else self.elevation_rad[:, which],
            **{name: getattr(self, name)[:, which] for name in ("azimuth_rad", "turn", "fired", "clear")},
        )

    def directions(self) -> Float32[np.ndarray, "H W 3"]:
        """Return unit vectors in the sensor's frame at the moment of firing."""
        flat = np.cos(self.elevation_rad)
        xyz = np.empty((*self.azimuth_rad.shape, 3), np.float32)
        np.multiply(flat, np.cos(self.azimuth_rad), out=xyz[..., 0])
        np.multiply(flat, np.sin(self.azimuth_rad), out=xyz[..., 1])
        xyz[..., 2] = np.sin(self.elevation_rad)
        return xyz

    def rays(
        self, pose: Float64[np.ndarray, "4 4"], pose_after: Float64[np.ndarray, "4 4"] | None = None
    ) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
        """Return where the rays begin and go in a scene, row by row.

        Args:
            pose: sensor pose in the scene at the beginning of a revolution.
            pose_after: sensor pose at its end, if the sensor moves; poses between are interpolated linearly.
        """
        local = self.directions().reshape(-1, 3)
        directions = local @ pose[:3, :3].T.astype(np.float32)
        origins = np.empty_like(directions)
        if pose_after is None:
            origins[:] = pose[:3, 3]
            return origins, directions
        turn = np.broadcast_to(self.turn, self.azimuth_rad.shape).reshape(-1, 1)
        directions += turn * (local @ (pose_after - pose)[:3, :3].T.astype(np.float32))
        directions /= np.sqrt(np.einsum("ni,ni->n", directions, directions))[:, None]
        np.multiply(turn, (pose_after - pose)[:3, 3].astype(np.float32), out=origins)
        origins += pose[:3, 3].astype(np.float32)
        return origins, directions


def footprint(directions: Float32[np.ndarray, "n 3"], divergence_rad: float) -> Float32[np.ndarray, "4 n 3"]:
    """Return four rays at the corners of a square inside each beam.

    Args:
        directions: unit direction vectors of the beams' central rays.
        divergence_rad: full angle of the beam; the corners lie at 7/10 of the radius, the mean of an even disc.
    """
    aside = np.zeros_like(directions)
    aside[:, 0], aside[:, 1] = -directions[:, 1], directions[:, 0]
    aside /= np.maximum(np.sqrt(np.einsum("ni,ni->n", aside, aside)), np.float32(1e-6))[:, None]
    up = np.cross(directions, aside)
    reach = np.float32(divergence_rad / 2 * 0.7 / math.sqrt(2))
    return np.stack([directions + reach * (a * aside + u * up) for a in (-1, 1) for u in (-1, 1)])


@lru_cache(maxsize=4)  # a sensor is asked for many scans in a row
def _aims(sensor: SensorModel) -> tuple[np.ndarray, ...]:
    """Return elevation, azimuth, turn, phase in columns, and what the carrier leaves clear, of all fine columns."""
    per_pixel = sensor.has_angles_per_pixel
    fine = sensor if per_pixel else sensor.fine()
    azimuth, elevation = fine.azimuth_rad.double().numpy(), fine.elevation_rad.double().numpy()
    phase, turn = np.zeros((1, 1)), azimuth / (2 * math.pi) % 1
    if fine.azimuth_offset_rad is not None:
        # A pixel belongs to the firing that looks into its column: what counts is the part of a column that is left.
        aside = fine.azimuth_offset_rad.double().numpy()[:, None]
        columns = -aside * (fine.width / (2 * math.pi))  # to the right is positive, as columns are counted
        phase = columns - np.round(columns)
        turn = (azimuth - aside) / (2 * math.pi) % 1
    clear = ~hidden_by_car(azimuth, elevation) if sensor.name in SENSORS_ON_CAR else True
    clear = np.broadcast_to(clear, (fine.height, fine.width))
    azimuth, elevation, turn, phase = (table.astype(np.float32) for table in (azimuth, elevation, turn, phase))
    return elevation, azimuth, turn, phase, clear
