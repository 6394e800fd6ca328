"""Observation of a scene: a scene, a sensor and a random stream → surface, signal and label of every pixel."""

from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int32, UInt16

from lidargrit.scans.marks import mark
from lidargrit.scans.sensors import SensorModel, SensorSetup
from lidargrit.scans.types import Scan
from lidargrit.simulator.beams import REVOLUTION_S, Beams
from lidargrit.simulator.echoes import Echoes, detect_echoes, edges
from lidargrit.simulator.mesh import Finish, Mesh, Objects
from lidargrit.simulator.power import (
    BeamNoise,
    Lasers,
    RaydropModel,
    Surfaces,
    levels,
    range_sigma_m,
    reflectance,
    return_probability,
)
from lidargrit.simulator.setups import setup_of
from lidargrit.simulator.tracing import Tracer, in_reach, objects_in_reach


@runtime_checkable
class ObservableScene(Protocol):
    """Interface of a scene that a sensor can observe."""

    @property
    def standing(self) -> Mesh:
        """Triangles of all that is no kept object."""
        ...

    def objects(self, time_s: float = 0.0) -> Objects:
        """Return the kept objects at a time, in seconds."""
        ...

    def sensor_pose(self, time_s: float = 0.0, height_m: float = 1.73) -> Float64[np.ndarray, "4 4"]:
        """Return the frame in the scene's, at a time, of a sensor of some height above the road."""
        ...


@dataclass(frozen=True, eq=False)
class Observation:
    """One simulated revolution, pixel by pixel: what is there, how likely it comes back, and what was measured.

    Rows fall from the top, columns go from straight behind clockwise, as in range images.

    Args:
        clean_range_m: range without noise, whether it came back or not; 0 where the ray meets nothing
            within the sensor's reach. The car that
            carries the sensor is not part of the scene.
        return_probability: probability of a return, given everything but the noise from pulse to pulse;
            ``return_mask`` is sampled with it.
        return_mask: True = the beam came back.
        blocked: True = the ray ends on the car that carries the sensor, and never comes back.
        range_m: measured range with noise; 0 for no return.
        reflectance: measured reflectance in [0, 1]; 0 for no return.
        label: class of what the ray meets, by SemanticKITTI's numbers; 0 for nothing.
        instance: number of the object that the ray meets; 0 for what is no single object.
        cos_incidence: cosine between ray and surface normal; 0 where the ray meets nothing.
        directions: unit vectors of the rays in the sensor's frame when each was fired.
        sensor_pose: transform from the sensor's frame to the world of the drive at the beginning of the revolution.
        fired_s: time of each ray since then, in seconds; None where the sensor stands still meanwhile.
    """

    clean_range_m: Float32[np.ndarray, "H W"]
    return_probability: Float32[np.ndarray, "H W"]
    return_mask: Bool[np.ndarray, "H W"]
    blocked: Bool[np.ndarray, "H W"]
    range_m: Float32[np.ndarray, "H W"]
    reflectance: Float32[np.ndarray, "H W"]
    label: UInt16[np.ndarray, "H W"]
    instance: Int32[np.ndarray, "H W"]
    cos_incidence: Float32[np.ndarray, "H W"]
    directions: Float32[np.ndarray, "H W 3"]
    sensor_pose: Float64[np.ndarray, "4 4"]
    fired_s: Float32[np.ndarray, "H W"] | None = None

    def scan(self, source: str) -> Scan:
        """Return the points that came back in the firing order of KITTI's files."""
        x, y = self.directions[..., 0], self.directions[..., 1]
        turn = np.arctan2(-y, -x)  # from -pi to pi, rising as the azimuth does from 0 to 2 pi
        # Rows are two runs already, which a stable sort joins in one pass.
        order = np.argsort(turn, axis=1, kind="stable")
        came_back = np.take_along_axis(self.return_mask, order, axis=1)
        ring, rank = np.nonzero(came_back)
        column = order[ring, rank]
        at = ring * self.range_m.shape[1] + column
        xyz_m = self.directions.reshape(-1, 3)[at] * self.range_m.ravel()[at][:, None]
        label = self.label.ravel()[at].astype(np.int64) | (self.instance.ravel()[at].astype(np.int64) & 0xFFFF) << 16
        return Scan(
            torch.from_numpy(xyz_m),
            torch.from_numpy(self.reflectance.ravel()[at]),
            torch.from_numpy(ring),
            torch.from_numpy(label),
            source=source,
            point_time_s=None if self.fired_s is None else torch.from_numpy(self.fired_s.ravel()[at]),
        )

    def surfaces(self, source: str, limits_m: tuple[float, float]) -> Scan:
        """Return a point on every surface within limits, without noise, in the firing order of KITTI's files.

        The reflectance marks which beams came back, and how bright; see :mod:`lidargrit.scans.marks`. Rays that
        end on the car that carries the sensor meet no surface.

        Args:
            limits_m: nearest and farthest range of a surface, in metres.
        """
        within = (self.clean_range_m >= limits_m[0]) & (self.clean_range_m <= limits_m[1]) & ~self.blocked
        marks = mark(torch.from_numpy(self.return_mask), torch.from_numpy(self.reflectance)).numpy()
        return replace(self, return_mask=within, range_m=self.clean_range_m, reflectance=marks).scan(source)


@dataclass(frozen=True)
class ObservationConfig:
    """Settings of one observation of a scene.

    Args:
        time_s: time at which the revolution begins.
        motion: True if the sensor moves during the revolution.
        wet: wetness of the ground, 0 (dry) to 1 (soaked).
        kept_columns_only: True to leave out the columns that the sensor's image leaves out.
        model: model of which beams return.
    """

    time_s: float = 0.0
    motion: bool = False
    wet: float = 0.0
    kept_columns_only: bool = False
    model: RaydropModel = field(default_factory=RaydropModel)


def observe_scene(
    scene: ObservableScene,
    sensor: SensorModel,
    scene_rng: np.random.Generator,
    beam_rng: np.random.Generator,
    config: ObservationConfig,
) -> Observation:
    """Observe a scene for one revolution.

    Everything but the sensor stands still during a revolution.

    Args:
        scene: triangles and sensor poses.
        scene_rng: source of what stays the same from one revolution to the next: the gain of every object, and the
            set-up of a sensor of which there are no scans.
        beam_rng: source of what differs from one revolution to the next.
        config: time, motion, wetness and raydrop model.
    """
    model, setup = config.model, setup_of(sensor, scene_rng)
    begun, ended = (scene.sensor_pose(config.time_s + after_s, setup.height_m) for after_s in (0.0, REVOLUTION_S))
    poses = (begun, ended) if config.motion else (begun,)
    beams = Beams.sample(sensor, beam_rng, setup.firing_jitter_rad)
    height, fine_width = beams.azimuth_rad.shape
    beam_noise = BeamNoise.sample(beam_rng, height, fine_width, model)
    stride = fine_width // sensor.width if config.kept_columns_only else 1
    kept = slice(None, None, stride)
    looked, beam_noise = beams.columns(kept), beam_noise.columns(kept)

    elevations_rad = float(beams.elevation_rad.min()), float(beams.elevation_rad.max())
    # A drive keeps the tree of all that stands over its frames; for a single scan, one of what is in reach is enough.
    drives = config.time_s > 0
    mesh = scene.standing if drives else in_reach(scene.standing, poses, elevations_rad, sensor.range_max_m)
    objects = objects_in_reach(scene.objects(config.time_s), poses, sensor.range_max_m)
    finish = Finish.join([mesh, objects.finish()])
    tracer, surfaces = Tracer(mesh, sensor.range_max_m, objects), Surfaces.of(finish, model, setup, config.wet)
    rays = looked.rays(*poses)
    first = tracer.cast(*rays)
    range_m = first.range_m.reshape(looked.azimuth_rad.shape)
    if stride == 1:
        beside = np.roll(range_m, 1, axis=1), np.roll(range_m, -1, axis=1)
    else:
        beside = _beside(tracer, beams, poses, stride)
    edge = edges(range_m, *beside, model.edge_share).ravel()
    echoes = detect_echoes(tracer, surfaces, rays, first, edge, model, setup)
    limits_m = sensor.range_min_m, min(setup.farthest_m or sensor.range_max_m, sensor.range_max_m)
    seen = _measure(finish, surfaces, echoes, looked, setup, beam_noise, scene_rng, limits_m, begun, model)
    fired_s = np.broadcast_to(looked.turn * np.float32(REVOLUTION_S), seen.range_m.shape)
    return replace(seen, fired_s=fired_s) if config.motion else seen


def _beside(
    tracer: Tracer, beams: Beams, poses: tuple[Float64[np.ndarray, "4 4"], ...], stride: int
) -> tuple[Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W"]]:
    """Cast the fine columns to the left and to the right of every ``stride``-th."""
    found = []
    for start in (stride - 1, 1):
        looked = beams.columns(slice(start, None, stride))
        found.append(tracer.cast(*looked.rays(*poses)).range_m.reshape(looked.azimuth_rad.shape))
    return np.roll(found[0], 1, axis=1), found[1]


def _measure(
    finish: Finish,
    surfaces: Surfaces,
    echoes: Echoes,
    beams: Beams,
    setup: SensorSetup,
    beam_noise: BeamNoise,
    scene_rng: np.random.Generator,
    limits_m: tuple[float, float],
    pose: Float64[np.ndarray, "4 4"],
    model: RaydropModel,
) -> Observation:
    """Decide by chance which echoes are noticed, and what is read from them."""
    shape, lasers = beams.azimuth_rad.shape, Lasers.of(setup, len(beams.azimuth_rad))
    label = np.append(finish.label, np.uint16(0))[echoes.triangle]
    instance = np.append(finish.instance, np.int32(0))[echoes.triangle]
    gains = np.float32(model.object_spread) * scene_rng.standard_normal(finish.instance.max() + 1, dtype=np.float32)
    gains[0] = 0  # what is no single object has none
    of_object = gains[instance]
    log_gain = (lasers.log_gain + beam_noise.patch).ravel() + of_object
    level = levels(echoes.power, log_gain, model)
    clear = beams.clear.ravel() & (echoes.range_m >= limits_m[0]) & (echoes.range_m <= limits_m[1])
    probability = np.where(clear, return_probability(level, model, beams.gap_share), np.float32(0))
    pulse_noise = np.float32(model.pulse_spread) * beam_noise.pulse.ravel()
    sigma_m = range_sigma_m(np.minimum(echoes.range_m, limits_m[1]), echoes.cos_incidence, setup).reshape(shape)
    range_m = echoes.range_m + (lasers.offset_m + sigma_m * beam_noise.range_noise).ravel()
    came_back = clear & beams.fired.ravel() & (level + pulse_noise > 0)
    came_back &= (range_m >= limits_m[0]) & (range_m <= limits_m[1])
    specular = surfaces.specular(echoes.triangle, echoes.cos_incidence)
    # An object that answers more strongly than others of its kind reads brighter too.
    scattered = surfaces.albedo[echoes.triangle] * np.exp(of_object)
    scattered = (scattered.reshape(shape) * lasers.reading).ravel()
    # The very pulse that comes back stronger reads brighter.
    chance = beam_noise.pulse.ravel() * surfaces.mottle[surfaces.material[echoes.triangle]]
    bright = reflectance(scattered, specular, level + pulse_noise, chance, echoes.range_m, model, setup)
    return Observation(
        clean_range_m=np.where(np.isinf(echoes.range_m), np.float32(0), echoes.range_m).reshape(shape),
        return_probability=probability.reshape(shape),
        return_mask=came_back.reshape(shape),
        blocked=~beams.clear,
        range_m=np.where(came_back, range_m, np.float32(0)).reshape(shape),
        reflectance=np.where(came_back, bright, np.float32(0)).reshape(shape),
        label=label.reshape(shape),
        instance=instance.reshape(shape),
        cos_incidence=echoes.cos_incidence.reshape(shape),
        directions=beams.directions(),
        sensor_pose=pose,
    )
