"""Streets as one mesh of all that they have, which the simulator never makes: what tests look at and compare with."""

import numpy as np

from lidargrit.simulator import Scene, Theme, _street
from lidargrit.simulator.mesh import Mesh, Objects


def street_of(seed: int, theme: Theme = "mixed") -> Scene:
    """Return the street that ends of a seed, which ``simulate`` scans; further stretches are no part of it."""
    return _street(seed, theme)[0]


def mesh_of(scene: Scene, time_s: float = 0.0) -> Mesh:
    """Return all triangles of a scene at a time, in seconds, those of kept objects too."""
    return Mesh.join([scene.standing, mesh_of_objects(scene.objects(time_s))])


def mesh_of_objects(objects: Objects) -> Mesh:
    """Return all triangles of kept objects in the frame of their scene, object after object."""
    finish, moved, part = objects.finish(), [np.zeros((0, 3, 3))], [np.zeros(0, np.int64)]
    for shape, frame, first in zip(objects.shapes, objects.frame, objects.first_part(), strict=True):
        moved.append(shape.triangles_m @ frame[:3, :3].T + frame[:3, 3])
        part.append(first + shape.part)
    every, triangles_m = np.concatenate(part), np.concatenate(moved).astype(np.float32)
    material, albedo, label = finish.material[every], finish.albedo[every], finish.label[every]
    return Mesh(material, albedo, label, finish.instance[every], triangles_m)
