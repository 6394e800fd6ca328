"""Simulated scans: a seed → a scene of triangles → the returns of a sensor in it."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import get_args

import numpy as np
from jaxtyping import Float64

from lidargrit.core.errors import ConfigError
from lidargrit.core.untrusted import FRAMES_AT_MOST
from lidargrit.scans.sensors import Sensor, SensorModel, load_sensor
from lidargrit.scans.types import Scan
from lidargrit.simulator.beams import REVOLUTION_S
from lidargrit.simulator.observation import Observation, ObservationConfig, observe_scene
from lidargrit.simulator.power import RaydropModel
from lidargrit.simulator.scene import Scene, Theme, sample_scene
from lidargrit.simulator.scene.long_road import LongRoad
from lidargrit.simulator.scene.plan_sampling import sample_street_plan
from lidargrit.simulator.scene.stretches import EXTENT_M
from lidargrit.simulator.setups import setup_of

__all__ = ["Observation", "RaydropModel", "Scene", "Theme", "frames_before_end", "observe", "poses_of", "simulate"]

FRAME_S = REVOLUTION_S  # from one frame to the next
ROAD_M = 100.0  # that our car drives in a street that ends: .97 of the returns are still there, after 140 m .17
_HDL64E_OF_KITTI = RaydropModel()
_DEFAULT = "hdl64e_kitti_odometry"


def simulate(
    seed: int,
    sensor: Sensor | None = None,
    *,
    theme: Theme = "mixed",
    frame: int = 0,
    frames: int = 1,
    motion: bool = False,
    wet: float = 0.0,
    kept_columns_only: bool = False,
    model: RaydropModel = _HDL64E_OF_KITTI,
) -> Scan:
    """Simulate one revolution of a sensor in a street sampled from a seed.

    A beam is lost when its received power, which falls with range, with incidence and on dark, glossy or transparent
    surfaces, stays below a threshold. The power's random part is alike along a ring and over an object, so that drops
    come in patches as they do on the road.

    Args:
        seed: seed of the street and of the noise, 0 or more; the same seed gives the same scan, bit for bit.
        sensor: sensor to simulate, its name or its file, with every column that it fires; the HDL-64E of KITTI odometry
            if not given.
        theme: kind of street.
        frame: index of the revolution, 0.1 s apart; the frames of one seed are a drive through one street.
        frames: number of the drive's frames that are wanted; 1 for as many as it takes to get to ``frame``. A street of
            which 100 m are driven ends 125 m from its start. A longer drive goes on through further stretches of the
            road, and its first frames see them, too, so that nothing appears from one frame to the next: give all
            frames of one drive the same number.
        motion: whether points stay as a moving car measures them, distorted by its motion; otherwise all are as seen
            from where the revolution began, which is how KITTI odometry stores them.
        wet: wetness of asphalt and concrete, from 0 (dry) to 1 (soaked).
        kept_columns_only: whether only the columns that the sensor's image keeps are cast, which takes a fraction of
            the time. The points are those of the whole scan that fall into these columns.
        model: model of which beams return.

    Returns:
        points in the firing order of KITTI's files: ring by ring from the top, each counter-clockwise from straight
        ahead; with ring, reflectance, and label as SemanticKITTI's files hold it (the instance in the upper 16 bits).

    Raises:
        ConfigError: a negative seed or frame, 100,000 frames or more, an unknown theme, or a wetness outside [0, 1].
        ScanError: not one beam came back.

    Example:
        >>> scan = simulate(seed=0)
        >>> int(scan.ring.max())
        63
    """
    seen = observe(
        seed,
        sensor,
        theme=theme,
        frame=frame,
        frames=frames,
        motion=motion,
        wet=wet,
        kept_columns_only=kept_columns_only,
        model=model,
    )
    return seen.scan(f"simulated scan {seed}" + (f", frame {frame}" if frame else ""))


def observe(
    seed: int,
    sensor: Sensor | None = None,
    *,
    theme: Theme = "mixed",
    frame: int = 0,
    frames: int = 1,
    motion: bool = False,
    wet: float = 0.0,
    kept_columns_only: bool = False,
    model: RaydropModel = _HDL64E_OF_KITTI,
) -> Observation:
    """Simulate one revolution as :func:`simulate` does, and return surface, signal and label of every pixel.

    Args, Raises: as for :func:`simulate`; without a return there is an observation all the same.

    Returns:
        arrays of one value for each pixel of ``sensor.fine()``, or of ``sensor`` if ``kept_columns_only``.
    """
    check_settings(seed, theme, frame, wet)
    check_settings(seed, theme, frames - 1)
    sensor = load_sensor(sensor or _DEFAULT)
    # Children of a seed: 0 is the street's, and each frame has one.
    beam_rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(frame + 1,)))
    config = ObservationConfig(FRAME_S * frame, motion, wet, kept_columns_only, model)
    if max(frames, frame + 1) <= frames_before_end(seed, theme):
        scene, street_rng = _street(seed, theme)
    else:
        road = _road(seed, theme)
        scene, street_rng = road.scene_at(config.time_s), road.rng
    seen = observe_scene(scene, sensor, copy.deepcopy(street_rng), beam_rng, config)
    return replace(seen, sensor_pose=scene.in_drive(seen.sensor_pose))


@lru_cache(maxsize=1)  # all frames of a drive have one street
def _street(seed: int, theme: Theme) -> tuple[Scene, np.random.Generator]:
    """Return the street of a seed, and its random stream after it was sampled."""
    street_rng = np.random.default_rng(seed).spawn(2)[0]
    return sample_scene(street_rng, theme), street_rng


@lru_cache(maxsize=1)
def _road(seed: int, theme: Theme) -> LongRoad:
    """Return the street of a seed that goes on."""
    return LongRoad(seed, theme)


def poses_of(
    seed: int, times_s: Sequence[float], sensor: SensorModel | None = None, theme: Theme = "mixed"
) -> list[Float64[np.ndarray, "4 4"]]:
    """Return the frame of the sensor in the street of a seed, at times in seconds after the first revolution begins.

    The height above the road is that of the sensor's set-up.
    """
    check_settings(seed, theme)
    scene, street_rng = _street(seed, theme)
    height_m = setup_of(sensor or load_sensor(_DEFAULT), copy.deepcopy(street_rng)).height_m
    if scene.speed_m_s * max(times_s, default=0.0) < EXTENT_M:
        return [scene.sensor_pose(time_s, height_m) for time_s in times_s]
    return _road(seed, theme).poses_at(times_s, height_m)


@lru_cache(maxsize=1024)
def frames_before_end(seed: int, theme: Theme = "mixed") -> int:
    """Return how many frames a drive may have whose street ends; a drive of more frames has a road that goes on."""
    check_settings(seed, theme)
    speed_m_s = sample_street_plan(np.random.default_rng(seed).spawn(2)[0], theme).speed_m_s
    return min(FRAMES_AT_MOST, 1 + int(ROAD_M / (speed_m_s * FRAME_S))) if speed_m_s else FRAMES_AT_MOST


def check_settings(seed: int, theme: Theme, frame: int = 0, wet: float = 0.0) -> None:
    """Refuse what cannot be simulated."""
    if not 0 <= frame < FRAMES_AT_MOST:
        raise ConfigError(f"the frame {frame}", f"a frame from 0 to {FRAMES_AT_MOST - 1}", "choose another frame")
    if not 0 <= wet <= 1:  # also refuses NaN
        raise ConfigError(f"wet {wet}", "a wetness from 0 (dry) to 1 (soaked)", "choose a number between")
    if seed < 0:
        raise ConfigError(f"the seed {seed}", "a seed of 0 or more", "choose another seed")
    if theme not in get_args(Theme):
        raise ConfigError(f"the theme {theme!r}", f"one of {', '.join(get_args(Theme))}", "choose one of them")
