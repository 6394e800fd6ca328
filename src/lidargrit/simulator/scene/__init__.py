"""A street scene: random numbers → triangles around a car with a sensor, at any time."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from lidargrit.scans.motion import as_poses
from lidargrit.simulator.mesh import Mesh, Objects
from lidargrit.simulator.scene.objects import ObjectBatch
from lidargrit.simulator.scene.parts import lay_out_first
from lidargrit.simulator.scene.plan_sampling import sample_street_plan
from lidargrit.simulator.scene.street_plan import StreetPlan, Theme

__all__ = ["Scene", "Theme", "sample_scene"]

SENSOR_HEIGHT_M = 1.73  # of the Velodyne above the road, Geiger et al., IJRR 2013, figure 3
# Yaw, pitch and roll of the sensor to the road: no sensor is mounted level, and a road falls to its sides.
# Planes fitted to the roads of five real drives: pitch -.4 to -.8 degrees, once 1.5; roll -1.8 to .2.
_ATTITUDE_RAD, _ATTITUDE_SPREAD_RAD = (0.0, -0.012, 0.0), (0.015, 0.016, 0.024)


@dataclass(frozen=True, eq=False)
class Scene:
    """Standing and moving objects around our car, which is not part of the scene.

    The world has z up, its origin on the road below the sensor at time 0, and x along the heading there. That of a
    further stretch of a road is moved by ``plan.offset_m``, so that coordinates stay small.

    Args:
        plan: layout of the roads and the ground.
        standing: triangles that are of this street alone: its ground, its houses, its walls and fences.
        still: kept objects that never move.
        moving: kept objects that do.
        attitude_rad: yaw, pitch and roll of our car relative to the road.
        begins_s: time of the drive at which our car is where u is 0.
    """

    plan: StreetPlan
    standing: Mesh
    still: Objects
    moving: tuple[ObjectBatch, ...]
    attitude_rad: Float64[np.ndarray, "3"]
    begins_s: float = 0.0

    @property
    def speed_m_s(self) -> float:
        """Speed of our own car, in metres per second."""
        return self.plan.speed_m_s

    def objects(self, time_s: float = 0.0) -> Objects:
        """Return the kept objects at a time, in seconds."""
        return Objects.join([self.still, *(batch.at(self.plan, time_s - self.begins_s) for batch in self.moving)])

    def sensor_pose(self, time_s: float = 0.0, height_m: float = SENSOR_HEIGHT_M) -> Float64[np.ndarray, "4 4"]:
        """Return the transform from the sensor's frame to the world at a time; our car keeps to its lane.

        Args:
            height_m: height of the sensor above the road.
        """
        here = self.plan.poses(np.array([self.speed_m_s * (time_s - self.begins_s)]), np.array([self.plan.our_v_m]))
        yaw, pitch, roll = self.attitude_rad
        ahead, slope = float(here.yaw_rad[0]) + yaw, here.slope[0]
        forward = np.array([np.cos(ahead), np.sin(ahead), 0.0])
        forward[2] = slope @ forward[:2] + pitch
        left = np.array([-np.sin(ahead), np.cos(ahead), 0.0])
        left[2] = slope @ left[:2] + roll
        forward /= np.linalg.norm(forward)
        left -= forward * (left @ forward)
        left /= np.linalg.norm(left)
        up = np.cross(forward, left)
        return as_poses(np.stack((forward, left, up), axis=1), here.xyz_m[0] + height_m * up)

    def in_drive(self, pose: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
        """Return a pose of this scene in the world in which its drive begins."""
        moved = pose.copy()
        moved[:3, 3] += self.plan.offset_m
        return moved


def sample_scene(rng: np.random.Generator, theme: Theme = "mixed") -> Scene:
    """Sample a street scene; the same state of the generator gives the same scene, bit for bit.

    Args:
        theme: dense city, suburb with gardens, open country, or mixed: chosen at random, mostly suburb and city.
    """
    plan = sample_street_plan(rng, theme)
    parts = lay_out_first(rng, plan)
    return Scene(plan, parts.standing, parts.still, parts.moving, sample_attitude(rng))


def sample_attitude(rng: np.random.Generator) -> Float64[np.ndarray, "3"]:
    """Sample yaw, pitch and roll of a car relative to the road."""
    return rng.normal(_ATTITUDE_RAD, _ATTITUDE_SPREAD_RAD)
