"""Street scenes: the same from the same numbers, sound triangles, clear of our own car, and laid out like streets."""

import numpy as np
import pytest

from lidargrit.core.errors import ConfigError
from lidargrit.scans import classes
from lidargrit.simulator import materials, simulate
from lidargrit.simulator.mesh import Finish
from lidargrit.simulator.scene import SENSOR_HEIGHT_M, sample_scene
from lidargrit.simulator.scene.body_types import BODY_TYPES
from lidargrit.simulator.scene.layout import driving, parked
from lidargrit.simulator.scene.objects import Placements
from lidargrit.simulator.scene.plan_sampling import sample_street_plan
from lidargrit.simulator.scene.settlement import lay_out_houses
from lidargrit.simulator.scene.vehicles import make_vehicles, vehicle_shape
from lidargrit.simulator.tracing import objects_in_reach
from whole_streets import mesh_of, mesh_of_objects

THEMES = ("city", "suburb", "country")
SEEDS = range(8)
CARS = (classes.CAR, classes.MOVING_CAR, classes.TRUCK, classes.MOVING_TRUCK)
FIELDS = ("triangles_m", "material", "albedo", "label", "instance")


@pytest.fixture(scope="module")
def scenes():
    return {(theme, seed): sample_scene(np.random.default_rng(seed), theme) for theme in THEMES for seed in SEEDS}


@pytest.fixture(scope="module")
def meshes(scenes):
    return {key: scene.standing for key, scene in scenes.items()}


@pytest.fixture(scope="module")
def finishes(scenes):
    return {key: Finish.join([scene.standing, scene.objects().finish()]) for key, scene in scenes.items()}


@pytest.mark.parametrize("theme", THEMES)
def test_one_state_one_scene(theme):
    np.random.seed(1)  # noqa: NPY002
    one = sample_scene(np.random.default_rng(7), theme)
    np.random.seed(2)  # noqa: NPY002
    two = sample_scene(np.random.default_rng(7), theme)
    for time_s in (0.0, 0.7):
        first, second = mesh_of(one, time_s), mesh_of(two, time_s)
        for field in FIELDS:
            assert np.array_equal(getattr(first, field), getattr(second, field)), field
        assert np.array_equal(one.sensor_pose(time_s), two.sensor_pose(time_s))
    assert len(mesh_of(sample_scene(np.random.default_rng(8), theme))) != len(mesh_of(one))


def test_mixed_draws_mostly_streets_with_houses():
    drawn = [sample_street_plan(np.random.default_rng(seed), "mixed").theme for seed in range(200)]
    assert set(drawn) == set(THEMES)
    assert drawn.count("country") < 40
    assert drawn.count("suburb") > drawn.count("city") > drawn.count("country")


def test_unknown_theme_is_refused():
    with pytest.raises(ConfigError, match="the theme 'village'; wanted one of city"):
        simulate(0, theme="village")


def test_triangles_are_sound(scenes, meshes):
    for mesh in (*meshes.values(), *(mesh_of(scenes[theme, 0]) for theme in THEMES)):
        assert np.isfinite(mesh.triangles_m).all()
        sides = mesh.triangles_m[:, 1:] - mesh.triangles_m[:, :1]
        area = np.linalg.norm(np.cross(sides[:, 0].astype(float), sides[:, 1].astype(float)), axis=1) / 2
        assert np.mean(area < 1e-7) < 0.002
        assert area.max() < 3000
        assert np.abs(mesh.triangles_m[..., 2]).max() < 60


def test_labels_materials_and_brightness_are_in_range(finishes):
    for finish in finishes.values():
        assert set(np.unique(finish.label)) <= classes.CLASSES.keys()
        assert finish.material.max() < len(materials.MATERIALS)
        assert finish.albedo.min() > 0
        assert finish.albedo.max() < 0.9
        leaves = finish.albedo[finish.material == materials.LEAVES]
        assert 0.2 < leaves.min() <= leaves.max() <= 0.6
        asphalt = finish.albedo[finish.label == classes.ROAD]
        assert 0.08 < asphalt.min() <= asphalt.max() < 0.3


def test_things_have_instances_and_the_ground_has_none(finishes):
    things = (*CARS, classes.PERSON, classes.MOVING_PERSON, classes.BICYCLIST, classes.MOVING_BICYCLIST)
    for finish in finishes.values():
        is_thing = np.isin(finish.label, things)
        assert (finish.instance[is_thing] > 0).all()
        assert (finish.instance[np.isin(finish.label, (classes.ROAD, classes.BUILDING, classes.VEGETATION))] == 0).all()
        pairs = np.unique(finish.instance[finish.instance > 0] * 1000 + finish.label[finish.instance > 0])
        assert len(np.unique(pairs // 1000)) == len(pairs)  # one class to an instance


@pytest.mark.parametrize("time_s", [0.0, 1.0])
def test_nothing_stands_in_our_own_car(scenes, time_s):
    low, high = np.array([-2.3, -0.95, 0.35 - SENSOR_HEIGHT_M]), np.array([2.3, 0.95, 0.3])
    for key, scene in scenes.items():
        pose = scene.sensor_pose(time_s)
        near_us = objects_in_reach(scene.objects(time_s), [pose], range_max_m=5.0)
        to_sensor = np.linalg.inv(pose)
        for mesh in (scene.standing, mesh_of_objects(near_us)):
            local = mesh.triangles_m @ to_sensor[:3, :3].T.astype(np.float32) + to_sensor[:3, 3].astype(np.float32)
            apart = (local.max(axis=1) < low) | (local.min(axis=1) > high)  # by their own boxes: stricter than need be
            near = ~apart.any(axis=1)
            assert not near.any(), (key, np.unique(mesh.label[near]))


def test_the_sensor_stands_over_the_road(scenes):
    for scene in scenes.values():
        start, later = scene.sensor_pose(), scene.sensor_pose(1.0)
        assert np.allclose(start[:3, :3] @ start[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.allclose(start[:3, 3], [0, 0, SENSOR_HEIGHT_M], atol=0.2)
        assert start[0, 0] > 0.99
        way = np.linalg.norm(later[:3, 3] - start[:3, 3])
        assert way == pytest.approx(scene.speed_m_s, rel=0.05, abs=0.01)
        mesh = scene.standing
        road = mesh.triangles_m[mesh.label == classes.ROAD].mean(axis=1)
        below = road[np.hypot(road[:, 0], road[:, 1]) < 2.5]
        assert np.abs(below[:, 2]).max() < 0.25


@pytest.mark.parametrize("theme", ["city", "suburb"])
def test_parked_cars_stand_at_kerbs_and_not_in_houses(theme):
    at_kerb, all_along = 0, 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        plan = sample_street_plan(rng, theme)
        town = lay_out_houses(rng, plan)
        placements = parked(rng, plan, town)
        assert not town.covers(placements.u_m, placements.v_m, 0.5).any()
        along = ~placements.across
        kerb = np.where(placements.v_m > 0, plan.edge_m[1], plan.edge_m[0])[along] - np.abs(placements.v_m[along])
        assert np.all((kerb > 0.9) & (kerb < 1.15))  # half a car and a hand
        assert (plan.in_side_street(placements.u_m[along], placements.v_m[along], 2.0) < 0).all()
        at_kerb, all_along = at_kerb + along.sum(), all_along + len(placements)
    assert at_kerb > 0.3 * all_along > 60  # others stand in side streets, beside houses, and in squares


def test_drivers_keep_their_distance():
    for seed in range(60):
        rng = np.random.default_rng(seed)
        plan = sample_street_plan(rng, "mixed")
        placements = driving(rng, plan, 8.0)
        ours = np.abs(placements.v_m - plan.our_v_m) < 1.7
        for time_s in (0.0, 1.0, 2.0):
            way = placements.speed_m_s * time_s * np.cos(placements.turn_rad) * ~placements.across
            assert (np.abs(placements.u_m + way - 8.0 * time_s)[ours & ~placements.across] > 7).all()


def test_houses_have_windows(meshes):
    shares = []  # of all upright walls, those that turn their backs and inner ones too
    for (theme, _), mesh in meshes.items():
        if theme == "country":
            continue
        sides = (mesh.triangles_m[:, 1:] - mesh.triangles_m[:, :1]).astype(float)
        normal = np.cross(sides[:, 0], sides[:, 1])
        area = np.linalg.norm(normal, axis=1) / 2
        near = np.hypot(*mesh.triangles_m.mean(axis=1)[:, :2].T) < 30
        upright = np.abs(normal[:, 2]) < 0.1 * 2 * area
        facade = (mesh.label == classes.BUILDING) & upright & near
        glass = facade & (mesh.material == materials.GLASS)
        if area[facade].sum() > 200:  # some streets are open to both sides
            shares.append(area[glass].sum() / area[facade].sum())
    assert len(shares) > 10
    assert 0.005 < np.mean(shares) < 0.3  # most windows have a blind: few of KITTI's walls read 0
    assert np.percentile(shares, 10) > 0.001


def test_the_number_of_triangles_is_bounded(scenes, meshes):
    of_the_street = np.array([len(mesh) for mesh in meshes.values()])  # these are built anew for every scan
    assert 4_000 < np.median(of_the_street) < 25_000
    assert of_the_street.max() < 60_000
    kept = [sum(len(shape) for shape in scene.still.shapes) for scene in scenes.values()]
    assert np.median(kept) > 200_000


def _slow_sight(town, point, eye):
    """Tell whether a house stands between, by many points on the way."""
    way = eye + np.linspace(0, 1, 1000)[:, None] * (point - eye)
    houses = town.houses
    for house in range(len(houses.length_m)):
        yaw, apart = houses.poses.yaw_rad[house], way - houses.poses.xyz_m[house, :2]
        x, y = (
            np.cos(yaw) * apart[:, 0] + np.sin(yaw) * apart[:, 1],
            np.cos(yaw) * apart[:, 1] - np.sin(yaw) * apart[:, 0],
        )
        inside = (np.abs(x) < houses.length_m[house] / 2) & (np.abs(y) < houses.depth_m[house] / 2)
        if inside.any() and not inside[-1] and not inside[0] and not houses.plain[house]:
            return False
    return True


@pytest.mark.parametrize("seed", range(4))
def test_things_count_as_far_only_behind_houses(seed):
    rng = np.random.default_rng(seed)
    plan = sample_street_plan(rng, "suburb")
    town = lay_out_houses(rng, plan)
    points = rng.uniform(-50, 50, (60, 2))
    away, straight = town.houses.nearest_approach_m(plan, points), plan.nearest_approach_m(points)
    nearest = [min(np.hypot(*(point - eye)) for eye in plan.viewpoints_m) for point in points]
    assert np.allclose(straight, nearest)
    hidden = away > straight
    assert np.array_equal(away[~hidden], straight[~hidden])
    for point in points[hidden]:
        assert not any(_slow_sight(town, point, eye) for eye in plan.viewpoints_m)
    checked = (straight > 12) & (straight < 40) & ~hidden
    assert np.mean([any(_slow_sight(town, point, eye) for eye in plan.viewpoints_m) for point in points[checked]]) > 0.8


def test_our_car_passes_what_is_drawn_in_detail(scenes):
    for scene in scenes.values():
        way = np.array([scene.sensor_pose(time_s)[:2, 3] for time_s in np.linspace(0, 2, 9)])
        assert scene.plan.nearest_approach_m(way).max() < 3.1  # half of what lies between two of the places that count


@pytest.mark.parametrize("kind", range(len(BODY_TYPES)))
def test_vehicles_stand_on_their_tyres_and_have_their_size(kind):
    body = BODY_TYPES[kind]
    for variant in range(3):
        shape = vehicle_shape(kind, variant)
        assert shape is vehicle_shape(kind, variant)  # made once
        assert 800 <= len(shape) <= 7000
        low, high = shape.box_m
        assert low[2] == pytest.approx(0, abs=1e-3)
        size = (high - low) / np.array(body.size_m)
        assert np.all((size > 0.75) & (size < (1.25, 1.4, 1.3)))  # with mirrors and plates
        material = shape.material[shape.part]
        tyres = shape.triangles_m[material == materials.RUBBER].reshape(-1, 3)
        lowest = tyres[tyres[:, 2] < 0.02]
        assert len(np.unique(np.sign(lowest[:, 0]) * 2 + np.sign(lowest[:, 1]))) == 4
        glass = shape.triangles_m[material == materials.GLASS]
        assert glass[..., 2].min() > 0.3 * high[2]
        assert len(glass) > 60


def test_objects_stretch_and_colour_their_shapes():
    shape = vehicle_shape(0, 0)
    placements = Placements.of(np.array([10.0, 30.0]), 2.0, np.array([0.0, 0.5]))
    plan = sample_street_plan(np.random.default_rng(0), "city")
    batch = make_vehicles(np.random.default_rng(3), np.array([0, 8]), placements, 5)
    objects = batch.at(plan)
    mesh, finish = mesh_of_objects(objects), objects.finish()
    assert len(mesh) == sum(len(s) for s in objects.shapes)
    assert len(finish) == sum(len(s.material) for s in objects.shapes)
    assert set(np.unique(mesh.instance)) == {5, 6}
    assert set(np.unique(mesh.label)) == {classes.CAR, classes.TRUCK}
    paint = mesh.albedo[(mesh.instance == 5) & (mesh.material == materials.PAINT)]
    assert np.unique(paint) == objects.albedo[0][0]
    first, frame = objects.shapes[0].triangles_m[100, 1].astype(float), objects.frame[0]
    assert np.allclose(mesh.triangles_m[100, 1], frame[:3, :3] @ first + frame[:3, 3], atol=1e-4)
    assert shape.box_m[1, 0] == pytest.approx(shape.triangles_m[..., 0].max())


def test_what_moves_moves_and_the_rest_stays(scenes):
    moved = 0
    for scene in scenes.values():
        one, two = scene.objects(0.0), scene.objects(1.0)
        assert one.shapes == two.shapes
        assert np.array_equal(one.instance, two.instance)
        assert all(label.max() < classes.MOVING_CAR for label in scene.still.label)
        way = np.linalg.norm(two.frame[:, :3, 3] - one.frame[:, :3, 3], axis=1)
        moving = np.array([label[0] >= classes.MOVING_CAR for label in one.label])
        assert (way[~moving] == 0).all()
        assert (way[moving] > 0.3).all()
        moved += len(np.unique(one.instance[moving]))
    assert moved > 20


def test_backdrop_leaves_little_bare_sky(scenes):
    """In most directions something stands higher than the sensor's top ring."""
    share = {theme: [] for theme in THEMES}
    for (theme, seed), scene in scenes.items():
        if seed > 3:
            continue
        corner = mesh_of(scene).triangles_m.reshape(-1, 3)
        flat = np.hypot(corner[:, 0], corner[:, 1])
        high = corner[(corner[:, 2] - SENSOR_HEIGHT_M) > np.tan(np.radians(2.6)) * flat]
        sector = ((np.arctan2(high[:, 1], high[:, 0]) + np.pi) / (2 * np.pi) * 120).astype(int)
        share[theme].append(len(np.unique(sector)) / 120)
    assert np.mean(share["city"]) > 0.7
    assert np.mean(share["suburb"]) > 0.7
    assert np.mean(share["country"]) > 0.4
