"""A street scene: random numbers → triangles all around a car that carries a sensor, at any time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np
from jaxtyping import Float64

from lidargrit.errors import ConfigError
from lidargrit.simulator.mesh import Mesh
from lidargrit.simulator.scene.buildings import add_houses
from lidargrit.simulator.scene.layout import add_furniture, add_gardens, add_greenery, traffic
from lidargrit.simulator.scene.movers import Herd
from lidargrit.simulator.scene.plan import Plan, Theme, draw_plan
from lidargrit.simulator.scene.roads import add_bridge, add_ground, add_markings
from lidargrit.simulator.scene.settlement import settle
from lidargrit.simulator.scene.shapes import Pile

__all__ = ["Scene", "Theme", "draw_scene"]

SENSOR_HEIGHT_M = 1.73  # of the Velodyne above the road, Geiger et al., IJRR 2013, figure 3


@dataclass(frozen=True, eq=False)
class Scene:
    """What stands and moves around our car, which is not part of it.

    The world has z up, its origin on the road below the sensor at time 0, and x along the heading there.

    Args:
        theme: city, suburb or country.
        plan: of the roads and the ground.
        standing: what never moves.
        moving: what does.
        attitude_rad: yaw, pitch and roll of our car against the road.
    """

    theme: str
    plan: Plan
    standing: Mesh
    moving: tuple[Herd, ...]
    attitude_rad: Float64[np.ndarray, "3"]

    @property
    def speed_m_s(self) -> float:
        """Our own car's."""
        return self.plan.speed_m_s

    def mesh(self, time_s: float = 0.0) -> Mesh:
        """Return all triangles at a time, in seconds."""
        pile = Pile()
        for herd in self.moving:
            herd.add_to(pile, self.plan, time_s)
        return Mesh.join([self.standing, pile.mesh()]) if len(pile) else self.standing

    def sensor_pose(self, time_s: float = 0.0) -> Float64[np.ndarray, "4 4"]:
        """Return the transform from the sensor's frame to the world at a time; our car keeps to its lane."""
        here = self.plan.poses(np.array([self.speed_m_s * time_s]), np.array([self.plan.our_v_m]))
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
        pose = np.eye(4)
        pose[:3, :3] = np.stack((forward, left, up), axis=1)
        pose[:3, 3] = here.xyz_m[0] + SENSOR_HEIGHT_M * up
        return pose


def draw_scene(rng: np.random.Generator, theme: Theme = "mixed") -> Scene:
    """Draw a street scene; the same state of the generator gives the same scene, bit for bit.

    Args:
        rng: all that is random comes from here.
        theme: dense city, suburb with gardens, open country, or drawn: mostly suburb and city.

    Raises:
        ConfigError: a theme of another name.
    """
    if theme not in get_args(Theme):
        raise ConfigError(f"the theme {theme!r}", f"one of {', '.join(get_args(Theme))}", "choose one of these")
    plan = draw_plan(rng, theme)
    pile = Pile()
    add_ground(pile, rng, plan)
    add_markings(pile, rng, plan)
    add_bridge(pile, rng, plan)
    town = settle(rng, plan)
    add_houses(pile, rng, plan, town.houses)
    add_gardens(pile, rng, plan, town)
    add_greenery(pile, rng, plan, town)
    add_furniture(pile, rng, plan)
    moving = []
    for herd in traffic(rng, plan, town):
        still, goes = herd.split()
        still.add_to(pile, plan)
        if len(goes.stands):
            moving.append(goes)
    return Scene(plan.theme, plan, pile.mesh(), tuple(moving), rng.normal(0, (0.015, 0.004, 0.004)))
