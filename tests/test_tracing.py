"""Rays against triangles by a slow loop, and what glass, edges and a beam's width do to an echo."""

from dataclasses import replace

import numpy as np
import pytest

from lidargrit.scans import classes
from lidargrit.scans.sensors import SensorSetup, load_sensor
from lidargrit.simulator import materials
from lidargrit.simulator.beams import REVOLUTION_S, Beams, footprint
from lidargrit.simulator.echoes import detect_echoes, edges
from lidargrit.simulator.mesh import Mesh
from lidargrit.simulator.power import RaydropModel, Surfaces, received_power
from lidargrit.simulator.tracing import NOTHING, Tracer, in_reach
from toy_scene import HEIGHT_M, ToyScene, box, road, street, wall

MODEL, SETUP = RaydropModel(), SensorSetup()
DIFFUSE = MODEL.materials[materials.PLASTER].diffuse  # the walls and boxes of these tests are of plaster


def random_rays(count, seed=0):
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.tile([0.0, 0.0, HEIGHT_M], (count, 1)) + rng.uniform(-1, 1, (count, 3))
    return origins.astype(np.float32), directions.astype(np.float32)


def meet_slowly(triangles, origin, direction):
    """Return range and triangle of the first hit. Source: Moller and Trumbore, J. Graphics Tools 2(1), 1997."""
    best, which = np.inf, NOTHING
    for index, (a, b, c) in enumerate(triangles.astype(np.float64)):
        across = np.cross(direction, c - a)
        determinant = (b - a) @ across
        if abs(determinant) < 1e-12:
            continue
        u = ((origin - a) @ across) / determinant
        q = np.cross(origin - a, b - a)
        v, t = (direction @ q) / determinant, ((c - a) @ q) / determinant
        if u >= 0 and v >= 0 and u + v <= 1 and 0 < t < best:
            best, which = t, index
    return best, which


def ahead(*heights_m):
    """Return rays from the sensor, straight ahead or up and down by some metres at 10 m."""
    directions = np.array([[10.0, 0.0, height] for height in heights_m], dtype=np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.tile(np.float32([0, 0, HEIGHT_M]), (len(directions), 1))
    return origins, directions


def test_hits_agree_with_a_slow_loop():
    mesh = street(leaves=40).standing
    origins, directions = random_rays(200)
    hits = Tracer(mesh).cast(origins, directions)
    slow = [meet_slowly(mesh.triangles_m, o.astype(float), d.astype(float)) for o, d in zip(origins, directions)]  # noqa: B905
    range_m, triangle = np.array([s[0] for s in slow]), np.array([s[1] for s in slow])
    assert np.array_equal(hits.triangle == NOTHING, triangle == NOTHING)
    met = triangle != NOTHING
    assert 80 < met.sum() < 200
    assert np.abs(hits.range_m[met] - range_m[met]).max() < 1e-3
    assert (hits.triangle[met] == triangle[met]).mean() > 0.99  # a ray through a shared edge may choose
    corners = mesh.triangles_m[hits.triangle[met]].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cos = np.abs((normal * directions[met]).sum(axis=1)) / np.linalg.norm(normal, axis=1)
    assert np.allclose(hits.cos_incidence[met], cos, atol=1e-4)
    assert np.isinf(hits.range_m[~met]).all()
    assert (hits.cos_incidence[~met] == 0).all()


@pytest.mark.parametrize("elevations_deg", [(-25, 3), (5, 20), (-40, -20)])
def test_what_is_out_of_reach_is_never_met(elevations_deg):
    rng = np.random.default_rng(1)
    triangles = rng.uniform(-60, 60, (4000, 1, 3)) + rng.normal(0, 2, (4000, 3, 3))
    mesh, pose = Mesh.of(triangles, materials.PLASTER, 0.4, classes.BUILDING), ToyScene(road()).sensor_pose()
    azimuth, elevation = rng.uniform(-np.pi, np.pi, 5000), np.radians(rng.uniform(*elevations_deg, 5000))
    flat = np.cos(elevation)
    directions = np.stack((flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)), axis=1)
    rays = np.tile(np.float32([0, 0, HEIGHT_M]), (5000, 1)), directions.astype(np.float32)
    low, high = np.radians(elevations_deg)
    less = in_reach(mesh, (pose,), (float(low), float(high)), 50.0)
    assert len(less) < 0.75 * len(mesh)
    one, two = (Tracer(m, 50.0).cast(*rays) for m in (mesh, less))
    assert np.array_equal(one.triangle == NOTHING, two.triangle == NOTHING)
    met = one.triangle != NOTHING
    assert met.any()
    assert np.allclose(one.range_m[met], two.range_m[met], atol=1e-4)
    assert one.range_m[met].max() <= 50


def test_glass_lets_a_part_through_twice():
    mesh = Mesh.join([wall(8.0, 0.02, materials.GLASS), wall(20.0, 0.5), wall(30.0, 0.5)])
    tracer, surfaces, rays = Tracer(mesh), Surfaces.of(mesh, MODEL, SETUP), ahead(0)
    first = tracer.cast(*rays)
    behind, light = tracer.cast_through(*rays, first, surfaces.passing())
    passes = SETUP.glass_passes
    assert first.range_m == pytest.approx(8)
    assert behind.range_m == pytest.approx(20, abs=1e-3)
    assert light == pytest.approx(passes**2)
    echo = detect_echoes(tracer, surfaces, rays, first, np.array([False]), MODEL, SETUP)
    assert echo.range_m == pytest.approx(20, abs=1e-3)
    assert echo.power == pytest.approx(passes**2 * 0.5 * DIFFUSE / (20**2 + MODEL.near_m**2), rel=1e-3)
    assert first.range_m == pytest.approx(8)  # what was handed in is as it was
    shut = replace(SETUP, glass_passes=0.0)
    echo = detect_echoes(tracer, Surfaces.of(mesh, MODEL, shut), rays, first, np.array([False]), MODEL, shut)
    assert echo.range_m == pytest.approx(8)


def test_light_ends_behind_two_panes_and_beyond_reach():
    panes = [wall(5.0 + k, 0.02, materials.GLASS) for k in range(3)]
    mesh, rays = Mesh.join([*panes, wall(20.0, 0.5)]), ahead(0)
    surfaces = Surfaces.of(mesh, MODEL, SETUP)
    behind, light = Tracer(mesh).cast_through(*rays, Tracer(mesh).cast(*rays), surfaces.passing())
    assert behind.range_m == pytest.approx(7, abs=1e-3)
    assert light == pytest.approx(SETUP.glass_passes**4)
    near = Mesh.join([panes[0], wall(20.0, 0.5)])
    tracer = Tracer(near, reach_m=15.0)
    behind, _ = tracer.cast_through(*rays, tracer.cast(*rays), Surfaces.of(near, MODEL, SETUP).passing())
    assert behind.triangle[0] == NOTHING
    assert np.isinf(behind.range_m[0])


def test_planes_have_no_edges_and_boxes_have():
    sensor = load_sensor("hdl64e_kitti_360")
    beams = Beams.sample(sensor, np.random.default_rng(0), 0.0)

    def edge(*parts):
        scene = ToyScene(*parts)
        first = Tracer(scene.standing).cast(*beams.rays(scene.sensor_pose()))
        range_m = first.range_m.reshape(64, 1024)
        found = edges(range_m, np.roll(range_m, 1, 1), np.roll(range_m, -1, 1), MODEL.edge_share)
        return found, first.triangle.reshape(64, 1024), range_m

    bare, _, _ = edge(road())
    assert bare[12:].sum() == 0  # below the horizon there is only the road
    found, triangle, range_m = edge(
        road(), Mesh.of(box((15, 0, 1), (4, 4, 6)), materials.PLASTER, 0.3, classes.BUILDING)
    )
    on_box = triangle >= 2
    border = on_box[:, 1:] != on_box[:, :-1]
    border &= np.abs(np.diff(1 / range_m)) > 0.1 / 15  # at its foot the box touches the road
    assert border[10:20].any()
    assert (found[:, 1:] | found[:, :-1])[border].all()
    assert found.mean() < 0.05


def test_beams_at_edges_mix_near_surfaces_and_choose_between_far_ones():
    def heard(gap_m, albedo, setup=SETUP):
        # The left half of the beam meets a front; the rest passes by and meets the wall behind.
        front = np.array([[(10, 0.0003, -5), (10, 9, -5), (10, 9, 9)], [(10, 0.0003, -5), (10, 9, 9), (10, 0.0003, 9)]])
        mesh = Mesh.join([Mesh.of(front, materials.PLASTER, albedo, 50), wall(10 + gap_m, 0.5)])
        tracer, rays = Tracer(mesh), ahead(0)
        surfaces = Surfaces.of(mesh, MODEL, setup)
        return detect_echoes(tracer, surfaces, rays, tracer.cast(*rays), np.array([True]), MODEL, setup)

    near = heard(0.4, 0.5)
    assert 10.05 < near.range_m < 10.35  # neither the one nor the other
    weights = np.array([2 / 5, 3 / 5]) * 0.5 * DIFFUSE / (np.array([10, 10.4]) ** 2 + MODEL.near_m**2)
    assert near.power == pytest.approx(weights.sum(), rel=1e-3)
    assert near.range_m == pytest.approx((weights * [10, 10.4]).sum() / weights.sum(), abs=1e-3)
    assert heard(5.0, 0.9).range_m == pytest.approx(10, abs=1e-3)
    assert heard(5.0, 0.1).range_m == pytest.approx(15, abs=1e-3)
    strict = replace(SETUP, split_exponent=3.0)
    assert heard(0.4, 0.5, strict).power == pytest.approx(near.power)  # heard as one
    for albedo, share in ((0.9, 2 / 5), (0.1, 3 / 5)):  # of the beam lies on the surface that answers
        assert heard(5.0, albedo, strict).power == pytest.approx(heard(5.0, albedo).power * share**3)


def test_footprint_lies_within_the_beam():
    _, directions = random_rays(100)
    corners = footprint(directions, 2e-3)
    angle = np.arccos(np.clip((corners.astype(np.float64) * directions).sum(axis=-1), -1, 1))
    sideways = np.linalg.norm(corners.astype(np.float64) - directions, axis=-1)
    assert np.allclose(sideways, 0.7e-3, rtol=1e-2)
    assert angle.max() < 1e-3


def test_rays_of_tables_and_of_lasers_that_look_aside():
    sensor = load_sensor("hdl64e_kitti_360").with_columns(128)
    plain = Beams.sample(sensor, np.random.default_rng(0), 0.0)
    assert np.allclose(plain.directions(), sensor.ray_directions().numpy(), atol=1e-6)
    elevation, azimuth = sensor.elevation_rad.expand(64, 128), sensor.azimuth_rad.expand(64, 128)
    table = replace(sensor, elevation_rad=elevation.clone(), azimuth_rad=azimuth.clone())
    assert np.array_equal(Beams.sample(table, np.random.default_rng(0), 0.0).directions(), plain.directions())

    step = 2 * np.pi / 128
    offset = sensor.elevation_rad[:, 0] * 0 + 3.25 * step  # a quarter of a column to the left, and three whole ones
    aside = Beams.sample(replace(sensor, azimuth_offset_rad=offset), np.random.default_rng(0), 0.0)
    assert np.allclose(aside.azimuth_rad - sensor.azimuth_rad.numpy(), 0.25 * step, atol=1e-5)
    late = (plain.turn - aside.turn) % 1
    assert np.allclose(late, 3.25 / 128, atol=1e-5)  # fired before the head points there


def test_jitter_stays_in_the_column_and_leaves_gaps():
    sensor = load_sensor("hdl64e_kitti_odometry")
    beams = Beams.sample(sensor, np.random.default_rng(3), 0.000719475)
    column = (np.pi - beams.azimuth_rad.astype(np.float64)) / (2 * np.pi) * 2048
    assert np.array_equal(np.floor(column), np.broadcast_to(np.arange(2048), (64, 2048)))
    assert 0.2 < (column % 1).std() < 0.25
    assert (~beams.fired).mean() == pytest.approx(0.033, abs=0.002)
    assert beams.gap_share == pytest.approx(0.033, abs=1e-5)
    pairs = ~beams.fired[:, 1:] & ~beams.fired[:, :-1]
    assert pairs.mean() < 0.003  # alone
    assert 0.85 < beams.clear.mean() < 0.95


def test_motion_bends_the_rays_evenly():
    sensor = load_sensor("hdl64e_kitti_360")
    beams = Beams.sample(sensor, np.random.default_rng(0), 0.0)
    scene = ToyScene(road(), speed_m_s=10.0, turn_rad_s=0.5)
    before, after = scene.sensor_pose(), scene.sensor_pose(REVOLUTION_S)
    origins, directions = beams.rays(before, after)
    still = beams.rays(before)[1].reshape(64, 1024, 3)
    origins, directions = origins.reshape(64, 1024, 3), directions.reshape(64, 1024, 3)
    assert np.allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-6)
    for column, turn in ((511, 0.0), (256, 0.25), (0, 0.5), (768, 0.75), (512, 1.0)):
        assert np.allclose(origins[0, column], [turn, 0, HEIGHT_M], atol=2e-3)
        angle = turn * 0.05
        turned = still[:, column] @ np.array(
            [[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
        )
        assert np.allclose(directions[:, column], turned, atol=2e-4)


def test_power_of_nothing_is_nothing():
    assert received_power(np.float32([0.3]), np.float32([np.inf]), MODEL)[0] == 0
    mesh, (origins, directions) = road(), ahead(5)
    hits = Tracer(mesh).cast(origins, directions)
    surfaces = Surfaces.of(mesh, MODEL, SETUP)
    echo = detect_echoes(Tracer(mesh), surfaces, (origins, directions), hits, np.array([True]), MODEL, SETUP)
    assert echo.power[0] == 0
    assert echo.triangle[0] == NOTHING
