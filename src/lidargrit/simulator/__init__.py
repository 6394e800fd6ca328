"""Simulated scans: a seed → a scene of triangles → the returns of a sensor in it."""

from __future__ import annotations

from typing import get_args

import numpy as np

from lidargrit.errors import ConfigError
from lidargrit.sensors import SensorModel, load_sensor
from lidargrit.simulator.beams import REVOLUTION_S
from lidargrit.simulator.observation import Observation, ObservationConfig, observe_scene
from lidargrit.simulator.power import RaydropModel
from lidargrit.simulator.scene import Scene, Theme, sample_scene
from lidargrit.structures import Scan

__all__ = ["Observation", "RaydropModel", "Scene", "Theme", "observe", "scene_of", "simulate"]

FRAME_S = REVOLUTION_S  # from one frame to the next
FRAMES_AT_MOST = 100_000  # each has a random stream of its own, and they are set up one after the other
_HDL64E_OF_KITTI = RaydropModel()


def simulate(
    seed: int,
    sensor: SensorModel | None = None,
    *,
    theme: Theme = "mixed",
    frame: int = 0,
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
        sensor: sensor to simulate, with every column that it fires; the HDL-64E of KITTI odometry if not given.
        theme: kind of street.
        frame: index of the revolution, 0.1 s apart; the frames of one seed are a drive through one street.
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
        ConfigError: a negative seed or frame, an unknown theme, or a wetness outside [0, 1].

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
        motion=motion,
        wet=wet,
        kept_columns_only=kept_columns_only,
        model=model,
    )
    return seen.scan(f"simulated scan {seed}" + (f", frame {frame}" if frame else ""))


def observe(
    seed: int,
    sensor: SensorModel | None = None,
    *,
    theme: Theme = "mixed",
    frame: int = 0,
    motion: bool = False,
    wet: float = 0.0,
    kept_columns_only: bool = False,
    model: RaydropModel = _HDL64E_OF_KITTI,
) -> Observation:
    """Simulate one revolution as :func:`simulate` does, and return surface, signal and label of every pixel.

    Args, Raises: as for :func:`simulate`.

    Returns:
        arrays of one value for each pixel of ``sensor.fine()``, or of ``sensor`` if ``kept_columns_only``.
    """
    check_settings(seed, theme, frame, wet)
    sensor = sensor or load_sensor("hdl64e_kitti_odometry")
    root = np.random.default_rng(seed)
    street_rng, beam_rng = root.spawn(2)
    if frame:
        beam_rng = root.spawn(frame)[-1]
    scene = sample_scene(street_rng, theme)
    config = ObservationConfig(FRAME_S * frame, motion, wet, kept_columns_only, model)
    return observe_scene(scene, sensor, street_rng, beam_rng, config)


def scene_of(seed: int, theme: Theme = "mixed") -> Scene:
    """Return the street of a seed, which :func:`simulate` scans: its triangles, and the path of the car.

    Raises:
        ConfigError: a negative seed, or an unknown theme.
    """
    check_settings(seed, theme)
    return sample_scene(np.random.default_rng(seed).spawn(2)[0], theme)


def check_settings(seed: int, theme: str, frame: int = 0, wet: float = 0.0) -> None:
    """Refuse what cannot be simulated.

    Raises:
        ConfigError: a negative seed, an unknown theme, or a frame or a wetness out of its bounds.
    """
    if not 0 <= frame < FRAMES_AT_MOST:
        raise ConfigError(f"the frame {frame}", f"a frame from 0 to {FRAMES_AT_MOST - 1}", "choose another frame")
    if not 0 <= wet <= 1:  # also refuses NaN
        raise ConfigError(f"wet {wet}", "a wetness from 0 (dry) to 1 (soaked)", "choose a number between")
    if seed < 0:
        raise ConfigError(f"the seed {seed}", "a seed of 0 or more", "choose another seed")
    if theme not in get_args(Theme):
        raise ConfigError(f"the theme {theme!r}", f"one of {', '.join(get_args(Theme))}", "choose one of them")
