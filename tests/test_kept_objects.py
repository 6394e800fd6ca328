"""Kept objects: rays meet them, one by one in their own frames, where they would meet one mesh of everything."""

import numpy as np
import pytest

from lidargrit.scans import classes
from lidargrit.scans.sensors import SensorSetup, load_sensor
from lidargrit.simulator import materials
from lidargrit.simulator.beams import REVOLUTION_S, Beams
from lidargrit.simulator.mesh import Finish, Mesh, Objects, Shape
from lidargrit.simulator.power import RaydropModel, Surfaces
from lidargrit.simulator.tracing import NOTHING, Hits, Tracer, objects_in_reach
from toy_scene import HEIGHT_M, box, road
from whole_streets import mesh_of, mesh_of_objects, street_of

SENSOR = load_sensor("hdl64e_kitti_360")
ROUNDED = 2  # rays of 65,536 that run along an edge to the last bit may pass on its other side


def by_part(hits, standing, objects):
    """Return hits on one mesh with the numbers that parts of kept objects have."""
    parts = [first + shape.part for first, shape in zip(objects.first_part(), objects.shapes, strict=True)]
    number = np.concatenate([np.arange(standing), standing + np.concatenate(parts), [NOTHING]])
    return Hits(hits.range_m, number[hits.triangle].astype(np.int32), hits.cos_incidence)


def same(one, two):
    met = one.triangle != NOTHING
    differ = (met != (two.triangle != NOTHING)).sum()
    both = met & (two.triangle != NOTHING)
    assert both.any()
    off = np.abs(one.range_m[both] - two.range_m[both]) > 1e-3
    assert differ + off.sum() <= ROUNDED
    alike = one.triangle == two.triangle
    assert (~alike).sum() <= 8  # faces that touch one another
    assert (np.abs(one.cos_incidence - two.cos_incidence)[alike] > 1e-3).sum() <= 8  # nor is it at edges within a part


@pytest.mark.parametrize(("seed", "moves"), [(1, False), (12, False), (5, True)])
def test_hits_are_those_of_one_mesh(seed, moves):
    scene = street_of(seed)
    poses = [scene.sensor_pose(time_s) for time_s in ((0.4, 0.4 + REVOLUTION_S) if moves else (0.4,))]
    rays = Beams.sample(SENSOR, np.random.default_rng(seed), 0.0014).rays(*poses)
    objects = scene.objects(0.4)
    assert len(objects) > 40
    whole, kept = Tracer(mesh_of(scene, 0.4), 120.0), Tracer(scene.standing, 120.0, objects)
    first = whole.cast(*rays)
    same(by_part(first, len(scene.standing), objects), kept.cast(*rays))
    assert (first.triangle >= len(scene.standing)).mean() > 0.05
    finishes = mesh_of(scene, 0.4), Finish.join([scene.standing, objects.finish()])
    (behind, light), (behind_kept, light_kept) = (
        tracer.cast_through(*rays, tracer.cast(*rays), Surfaces.of(finish, RaydropModel(), SensorSetup()).passing())
        for tracer, finish in zip((whole, kept), finishes, strict=True)
    )
    same(by_part(behind, len(scene.standing), objects), behind_kept)
    assert (light != light_kept).sum() <= ROUNDED
    assert (light < 1).any()


def cube(*frames):
    shape = Shape(box((0, 0, 0.5), (2, 1, 1)).astype(np.float32), np.zeros(12, np.uint8), np.zeros(1, np.uint8))
    albedo, label = np.full(1, 0.5, np.float32), np.full(1, classes.CAR, np.uint16)
    count = len(frames)
    return Objects(
        (shape,) * count, np.stack(frames), (albedo,) * count, (label,) * count, np.arange(count, dtype=np.int32)
    )


def frame(x, y, z, yaw=0.0, stretch=(1, 1, 1), slope=(0, 0)):
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    turn[2, :2] = np.array(slope) @ turn[:2, :2]
    turn[:3, :3] *= stretch
    turn[:3, 3] = x, y, z
    return turn


@pytest.mark.parametrize(
    "frames",
    [
        [frame(-6, 0.02, 0), frame(-9, -0.3, 0.2, 0.4)],  # straight behind, where azimuths wrap
        [frame(0, 0, 0.1, 0.3, (3, 5, 4))],  # around the sensor
        [frame(0, 0, HEIGHT_M + 0.5, 0.3, (8, 8, 1)), frame(2, 0, -0.5, 1.0)],  # above and below it
        [
            frame(5, 3, 0, 0.7, (2, 0.5, 1.6), (0.1, -0.07)),
            frame(9, 5, 0, 2.0),
        ],  # stretched, leaning, one behind the other
    ],
)
def test_windows_wrap_and_boxes_around_the_sensor_span_all(frames):
    objects = cube(*frames)
    elevation = np.tile(np.linspace(-1.3, 1.3, 60), 400)
    azimuth = np.repeat(np.linspace(-np.pi, np.pi, 400), 60)
    flat = np.cos(elevation)
    directions = np.stack((flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)), axis=1)
    origins = np.tile([0.0, 0.0, HEIGHT_M], (24_000, 1)) + np.linspace(0, 1, 24_000)[:, None] * [0.9, 0.2, 0.0]
    rays = origins.astype(np.float32), directions.astype(np.float32)
    one = Tracer(Mesh.join([road(), mesh_of_objects(objects)]), 60.0).cast(*rays)
    two = Tracer(road(), 60.0, objects).cast(*rays)
    same(by_part(one, 2, objects), two)
    assert (two.triangle >= 2).mean() > 0.002


def test_far_objects_are_left_out_and_the_rest_keep_their_order():
    objects = cube(frame(5, 0, 0), frame(400, 0, 0), frame(50, 0, 0))
    assert objects_in_reach(objects, [np.eye(4)], 120.0).instance.tolist() == [0, 2]
    away = np.eye(4)
    away[0, 3] = 380
    assert objects_in_reach(objects, [np.eye(4), away], 120.0).instance.tolist() == [0, 1, 2]
    assert len(objects_in_reach(Objects.none(), [np.eye(4)], 120.0)) == 0
    assert materials.MATERIALS[objects.finish().material[0]].name == "asphalt"
