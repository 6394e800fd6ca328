"""The lidar equation, and which beams come back: by range, incidence and material, in patches, as likely as said."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtri

from lidargrit.core.errors import ConfigError
from lidargrit.scans import classes
from lidargrit.scans.sensors import SensorSetup, load_sensor
from lidargrit.simulator import materials
from lidargrit.simulator.beams import Beams
from lidargrit.simulator.kitti_car import hidden_by_car
from lidargrit.simulator.mesh import Mesh
from lidargrit.simulator.observation import ObservationConfig, observe_scene
from lidargrit.simulator.power import RaydropModel, Surfaces, received_power, reflectance, return_probability
from lidargrit.simulator.setups import PACKAGED
from toy_scene import HEIGHT_M, ToyScene, box, quad, road, street, wall

MODEL = RaydropModel()
SETUP = SensorSetup(range_sigma_m=0.02, log_gain=PACKAGED["hdl64e_kitti_odometry"].log_gain)
GAPS = replace(SETUP, firing_jitter_rad=np.pi / 1024 / ndtri(1 - 0.033 / 2))
SENSOR = replace(load_sensor("hdl64e_kitti_odometry").with_columns(1024), setup=SETUP)


def look(scene, beam_seed=0, scene_seed=0, sensor=SENSOR, setup=None, **config):
    sensor = sensor if setup is None else replace(sensor, setup=setup)
    streams = (np.random.default_rng(seed) for seed in (scene_seed, beam_seed))
    return observe_scene(scene, sensor, *streams, ObservationConfig(**config))


@pytest.fixture(scope="module")
def seen():
    """Return many looks at one scene; its objects keep their gains."""
    return [look(street(), beam_seed=seed, setup=GAPS) for seed in range(12)]


def brightness(material, albedo, cos_incidence, model=MODEL, wet=0.0):
    surfaces = Surfaces.of(wall(10.0, albedo, material), model, SETUP, wet)
    return float(surfaces.brightness(np.int32([0]), np.float32([cos_incidence]))[0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"least_power": 0.0}, "got least_power=0; wanted a power above 0"),
        ({"patch_deg": 0.0}, "got patch_deg=0; wanted 0.01 or more"),
        ({"patch_deg": float("nan")}, "got patch_deg=nan"),
    ],
)
def test_a_model_with_which_no_scan_can_be_simulated_is_refused(change, message):
    with pytest.raises(ConfigError, match=message):
        replace(MODEL, **change)


def test_power_falls_as_the_square_of_range_far_away():
    def power(range_m, model=MODEL):
        return float(received_power(np.float32([0.3]), np.float32([range_m]), model)[0])

    assert power(400) == pytest.approx(power(200) / 4, rel=0.01)
    assert power(1) < 1.02 * power(0.1)  # out of focus close by
    fog = replace(MODEL, extinction_per_m=0.01)
    assert power(50, fog) == pytest.approx(power(50) * np.exp(-1.0), rel=1e-5)


def test_surfaces_answer_by_their_material():
    plaster = materials.MATERIALS[materials.PLASTER].diffuse
    assert brightness(materials.PLASTER, 0.4, 0.5) == pytest.approx(0.2 * plaster)  # Lambert's law
    paint = materials.MATERIALS[materials.PAINT]
    square, oblique = (brightness(materials.PAINT, 0.1, cos) for cos in (1.0, 0.7))
    assert square == pytest.approx(0.1 * paint.diffuse + paint.gloss)
    assert oblique == pytest.approx(0.07 * paint.diffuse, rel=0.01)  # beside the lobe
    assert brightness(materials.FOIL, 0.5, 0.7) > 5 * brightness(materials.PLASTER, 0.5, 0.7)
    assert brightness(materials.PAINT, 0.1, 1.0, replace(MODEL, gloss=2.0)) == pytest.approx(square + paint.gloss)
    assert Surfaces.of(road(), MODEL, SETUP).brightness(np.int32([-1]), np.float32([0.0]))[0] == 0


def test_wet_ground_is_darker_but_for_a_mirror_like_lobe():
    for material in (materials.ASPHALT, materials.CONCRETE):
        soaked = 0.3 * materials.MATERIALS[material].diffuse * (1 - MODEL.wet_darkening)
        assert brightness(material, 0.3, 0.3, wet=1.0) == pytest.approx(0.3 * soaked, rel=1e-3)
        assert brightness(material, 0.3, 1.0, wet=1.0) == pytest.approx(soaked + MODEL.wet_gloss, rel=1e-3)
    assert brightness(materials.PLASTER, 0.3, 0.3, wet=1.0) == brightness(materials.PLASTER, 0.3, 0.3)
    dry, wet = (look(ToyScene(road()), wet=wet).return_mask[:40].mean() for wet in (0.0, 1.0))
    assert wet < dry - 0.02


def test_drawn_mask_agrees_with_the_probability():
    # The patches along rings are given, so one look's probability counts for that look; over many they must agree.
    scene, sensor = street(leaves=0), SENSOR.with_columns(2048)
    looks = [look(scene, seed, sensor=sensor) for seed in range(10)]
    probability = np.concatenate([one.return_probability.ravel() for one in looks])
    mask = np.concatenate([one.return_mask.ravel() for one in looks])
    for low in np.arange(0.05, 0.95, 0.1):
        at = (probability > low) & (probability <= low + 0.1)
        assert at.sum() > 600
        tolerance = 4 * np.sqrt(0.25 / at.sum())
        assert mask[at].mean() == pytest.approx(probability[at].mean(), abs=tolerance)
    assert not mask[probability == 0].any()


def test_probability_is_that_of_a_log_normal_factor():
    levels = np.linspace(-1, 1, 9).astype(np.float32)
    draws = levels[:, None] + MODEL.pulse_spread * np.random.default_rng(0).standard_normal(100_000) > 0
    expected = draws.mean(axis=1) * (1 - 0.033)
    assert np.allclose(return_probability(levels, MODEL, 0.033), expected, atol=0.006)
    assert return_probability(np.float32([-np.inf]), MODEL, 0.033)[0] == 0
    steady = replace(MODEL, pulse_spread=0.0)
    assert return_probability(np.float32([-0.1, 0.1]), steady, 0.0).tolist() == [0, 1]


def test_gaps_are_part_of_the_probability(seen):
    near_wall = (seen[0].label == classes.BUILDING) & (seen[0].clean_range_m < 25) & ~seen[0].blocked
    share = np.mean([s.return_mask[near_wall].mean() for s in seen])
    said = np.mean([s.return_probability[near_wall].mean() for s in seen])
    assert share == pytest.approx(said, abs=0.003)
    assert said == pytest.approx(1 - 0.033, abs=0.003)


def test_road_is_lost_in_the_distance():
    scene = look(ToyScene(road(0.17)))  # as scenes draw asphalt
    upper = scene.clean_range_m[:45]
    rate = [
        scene.return_mask[:45][(upper > low) & (upper <= high)].mean() for low, high in ((10, 20), (25, 40), (60, 90))
    ]
    assert rate[0] > 0.98
    assert rate[1] > 0.9
    assert rate[2] < 0.4


def test_dark_bodies_drop_at_grazing_incidence_and_white_walls_do_not():
    def rate(material, albedo, degrees):
        angle = np.radians(degrees)
        aside = np.array([np.sin(angle), np.cos(angle), 0]) * 3
        low, high = np.array([15, 0, -4]), np.array([15, 0, 6])
        front = quad(low - aside, low + aside, high + aside, high - aside)
        scene = look(
            ToyScene(Mesh.of(front, material, albedo, classes.CAR, 1)), model=replace(MODEL, object_spread=0.0)
        )
        return scene.return_mask[:30][scene.instance[:30] == 1].mean()

    assert rate(materials.PLASTER, 0.5, 0) == 1
    assert rate(materials.PLASTER, 0.5, 75) > 0.99
    assert rate(materials.PAINT, 0.0015, 0) > 0.9  # the lobe
    assert rate(materials.PAINT, 0.0015, 75) < 0.3


def test_foil_is_seen_farther():
    def farthest_m(material):
        model, setup = replace(MODEL, patch_spread=0.0, object_spread=0.0), replace(SETUP, log_gain=())
        for far in range(20, 120, 10):
            plate = Mesh.of(quad((far, -4, 0), (far, 4, 0), (far, 4, 5), (far, -4, 5)), material, 0.02, 81, 1)
            scene = look(ToyScene(plate), model=model, setup=setup)
            if scene.return_mask[scene.instance == 1].mean() < 0.5:
                return far
        return 120

    assert farthest_m(materials.FOIL) == 120
    assert farthest_m(materials.PLASTER) < 100


def test_glass_shows_what_is_behind_it_sometimes(seen):
    behind_window = np.zeros_like(seen[0].blocked)
    behind_window[15:35, 240:272] = True  # the window is to the left, 6 m away, and the wall 13 m
    range_m = np.concatenate([s.range_m[behind_window] for s in seen])
    came_back = range_m > 0
    assert 0.2 < came_back.mean() <= 1
    assert (range_m[came_back] > 12.5).mean() > 0.2
    dusty = look(street(), setup=replace(GAPS, glass_scatters=400.0)).range_m[behind_window]
    assert (dusty > 0).mean() > 0.9
    assert dusty.max() < 7  # the pane itself


def test_drops_stand_in_patches(seen):
    dropped, alike = [], []
    for s in seen:
        drop = ~s.return_mask & ~s.blocked
        pair = (s.label[:, 1:] == s.label[:, :-1]) & (s.return_probability[:, 1:] > 0) & (s.clean_range_m[:, 1:] > 30)
        pair &= (s.label == classes.ROAD)[:, 1:]
        dropped.append(drop[:, 1:][pair])
        alike.append((drop[:, 1:] & drop[:, :-1])[pair])
    rate, both = np.concatenate(dropped).mean(), np.concatenate(alike).mean()
    assert 0.05 < rate < 0.7
    assert (both - rate**2) / (rate - rate**2) > 0.4  # the correlation of neighbours; coin flips have 0
    assert 1 / (1 - both / rate) > 1.5 / (1 - rate)  # mean length of runs, against that of coin flips


def test_lasers_differ_and_keep_their_gain():
    gains = np.random.default_rng(0).normal(0, 1, 64)

    def lost(beam_seed, spread, sensor=SENSOR):
        model, setup = replace(MODEL, patch_spread=0.0, pulse_spread=0.01), SensorSetup(log_gain=tuple(spread * gains))
        return ~look(ToyScene(road()), beam_seed, sensor=sensor, model=model, setup=setup).return_mask[9:15]

    for sensor in (SENSOR, load_sensor("hdl64e_kitti_360")):
        one, two, even = lost(0, 1.0, sensor), lost(1, 1.0, sensor), lost(0, 0.0, sensor)
        assert (one == two).mean() > 0.97
        assert (one == even).mean() < 0.9


def test_another_sensor_is_on_another_car():
    assert Beams.sample(replace(SENSOR, name="hdl64e_kitti_of_mine"), np.random.default_rng(0), 0.0).clear.all()


def test_readings_of_lasers_reach_the_reflectance():
    model = replace(MODEL, reflectance_spread=0.0, object_spread=0.0, patch_spread=0.0)
    setup = SensorSetup(log_gain=(2.0,) * 64)
    plain, dim = (
        look(ToyScene(wall(8.0, 0.6)), model=model, setup=replace(setup, reading=(factor,) * 64))
        for factor in (1.0, 0.5)
    )
    square = plain.return_mask & (plain.cos_incidence > 0.9)
    assert np.array_equal(plain.return_mask, dim.return_mask)
    assert np.abs(dim.reflectance - plain.reflectance / 2)[square].max() < 0.011  # hundredths


def test_the_car_hides_the_same_rays_in_every_scan(seen):
    assert all(np.array_equal(s.blocked, seen[0].blocked) for s in seen)
    assert not any(s.return_mask[s.blocked].any() for s in seen)
    share = seen[0].blocked.mean(axis=1)
    assert not share[:42].any()
    assert (np.diff(share[[42, 51, 55, 57, 61, 63]]) > 0).all()  # more and more towards the roof
    assert 0.4 < share[63] < 0.55  # of 67 real scans 0.50 are lost there
    straight = hidden_by_car(np.radians([[-90.0, 0.0, 90.0, 180.0, -180.0]]), np.radians([[-22.0], [-2.0]]))
    assert straight.tolist() == [[False, True, False, True, True], [False] * 5]
    assert not look(ToyScene(road()), sensor=load_sensor("os1_64")).blocked.any()


def test_measured_range_is_noisy_and_clean_range_is_not(seen):
    one = seen[0]
    difference = (one.range_m - one.clean_range_m)[one.return_mask]
    assert difference.std() == pytest.approx(SETUP.range_sigma_m, rel=0.05)
    assert abs(difference.mean()) < 1e-3
    assert (one.range_m[~one.return_mask] == 0).all()
    flat = (one.label == classes.ROAD) & (one.clean_range_m > 5) & (one.clean_range_m < 12)
    height = one.directions[..., 2] * one.clean_range_m
    assert np.abs(height[flat] + HEIGHT_M).mean() < 5e-3  # but for edges


def test_nothing_is_met_beyond_the_reach():
    scene = look(ToyScene(road(), wall(118.0, 0.9), wall(125.0, 0.9)))
    assert scene.clean_range_m.max() <= 120
    sky = scene.clean_range_m == 0
    assert sky.any()
    for name in ("label", "instance", "cos_incidence", "return_probability", "range_m", "reflectance"):
        assert (getattr(scene, name)[sky] == 0).all()


def test_reflectance_follows_albedo_until_the_echo_is_weak():
    def reads(scattered, level, chance=0.0, specular=0.0):
        given = (np.float32([v]) for v in (scattered, specular, level, chance, 10.0))
        return float(reflectance(*given, MODEL, SensorSetup())[0])

    assert reads(0.3, 5) == pytest.approx(0.3)
    assert reads(0.6, 5) == pytest.approx(0.6)
    between = (MODEL.dim_level + MODEL.bright_level) / 2
    assert reads(0.3, between) == pytest.approx(0.3 * (1 + MODEL.dim_share) / 2, abs=0.006)
    assert reads(0.3, MODEL.dim_level) == 0
    assert reads(0.3, MODEL.dim_level + 1e-3) == pytest.approx(0.3 * MODEL.dim_share, abs=0.006)
    assert reads(0.3, 5, chance=0.1) == pytest.approx(0.33)
    assert reads(0.5, 5, specular=3.0) == pytest.approx(0.99)
    scene = look(ToyScene(road(), wall(20.0, 0.6)))
    near = scene.return_mask & (scene.clean_range_m < 22) & (scene.cos_incidence > 0.1)
    asphalt, plaster = (materials.MATERIALS[m].diffuse for m in (materials.ASPHALT, materials.PLASTER))
    means = [scene.reflectance[near & (scene.label == label)].mean() for label in (classes.ROAD, classes.BUILDING)]
    assert means == pytest.approx([0.26 * asphalt, 0.6 * plaster], abs=0.06)


def test_boxes_have_their_own_class_and_number():
    car = Mesh.of(box((10, 0, 0.8), (4, 2, 1.2)), materials.PAINT, 0.3, classes.CAR, 7)
    scene = look(ToyScene(road(), car))
    assert set(np.unique(scene.label)) == {0, classes.ROAD, classes.CAR}
    assert (scene.instance[scene.label == classes.CAR] == 7).all()
    assert (scene.instance[scene.label == classes.ROAD] == 0).all()
