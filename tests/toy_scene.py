"""A scene small enough to know by heart: a road, a white wall, cars, a foil, a window, and leaves."""

import numpy as np

from lidargrit.scans import classes
from lidargrit.simulator import materials
from lidargrit.simulator.mesh import Mesh, Objects

HEIGHT_M = 1.73


def quad(a, b, c, d):
    return np.array([[a, b, c], [a, c, d]], dtype=float)


def box(middle, size):
    low, high = np.asarray(middle) - np.asarray(size) / 2, np.asarray(middle) + np.asarray(size) / 2
    faces = []
    for axis in range(3):
        one, two = (axis + 1) % 3, (axis + 2) % 3
        for end in (low, high):
            corners = np.tile(end, (4, 1))
            for corner, (p, q) in zip(corners, ((0, 0), (1, 0), (1, 1), (0, 1)), strict=True):
                corner[one], corner[two] = (low, high)[p][one], (low, high)[q][two]
            faces.append(quad(*corners))
    return np.concatenate(faces)


def road(albedo=0.26):
    flat = quad((-300, -300, 0), (300, -300, 0), (300, 300, 0), (-300, 300, 0))
    return Mesh.of(flat, materials.ASPHALT, albedo, classes.ROAD)


def wall(x_m, albedo=0.4, material=materials.PLASTER, half_width_m=40.0):
    upright = quad((x_m, -half_width_m, -5), (x_m, half_width_m, -5), (x_m, half_width_m, 60), (x_m, -half_width_m, 60))
    return Mesh.of(upright, material, albedo, classes.BUILDING)


class ToyScene:
    """Mounted where KITTI's sensor is; may drive ahead and turn left."""

    def __init__(self, *parts, speed_m_s=0.0, turn_rad_s=0.0):
        self.standing, self.speed_m_s, self.turn_rad_s = Mesh.join(parts), speed_m_s, turn_rad_s

    def objects(self, time_s=0.0):
        return Objects.none()

    def sensor_pose(self, time_s=0.0, height_m=HEIGHT_M):
        angle = self.turn_rad_s * time_s
        pose = np.eye(4)
        pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose[:3, 3] = self.speed_m_s * time_s, 0.0, height_m
        return pose


def street(leaves=1500):
    rng = np.random.default_rng(0)
    middles = np.stack((rng.uniform(-40, 40, leaves), rng.uniform(-14, -9, leaves), rng.uniform(0, 5, leaves)), axis=1)
    crown = middles[:, None] + rng.normal(0, 0.1, (leaves, 3, 3))
    return ToyScene(
        road(),
        Mesh.of(box((0, 15, 5), (200, 4, 10)), materials.PLASTER, 0.5, classes.BUILDING),
        Mesh.of(box((8, -4, 0.8), (4.2, 1.7, 1.2)), materials.PAINT, 0.004, classes.CAR, 1),
        Mesh.of(box((-12, -4, 0.8), (4.2, 1.7, 1.2)), materials.PAINT, 0.5, classes.CAR, 2),
        Mesh.of(box((20, 3, 3), (0.05, 0.7, 0.7)), materials.FOIL, 0.5, classes.TRAFFIC_SIGN, 3),
        Mesh.of(quad((-5, 6, 0), (5, 6, 0), (5, 6, 3), (-5, 6, 3)), materials.GLASS, 0.02, classes.BUILDING),
        Mesh.of(crown, materials.LEAVES, 0.35, classes.VEGETATION),
    )
