"""The simulated drive: the same scan from the same seed, KITTI's firing order, and sensors of all kinds."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import ConfigError
from lidargrit.scans import classes
from lidargrit.scans.projection import project, unproject
from lidargrit.scans.projection.unfolding import rings_from_firing_order
from lidargrit.scans.sensors import load_sensor
from lidargrit.simulator import RaydropModel, observe, poses_of, simulate

SEEDS = range(8)
MODEL = RaydropModel()
ARRAYS = ("points_xyz_m", "reflectance", "ring", "label")


@pytest.fixture(scope="module")
def sensor():
    return load_sensor("hdl64e_kitti_odometry")


@pytest.fixture(scope="module")
def seen(sensor):
    """Return, of a few streets, all that is known of every pixel of 1024 columns."""
    return [observe(seed, sensor.with_columns(1024)) for seed in SEEDS]


street = functools.cache(simulate)


def same(one, two):
    return all(torch.equal(getattr(one, name), getattr(two, name)) for name in ARRAYS)


@pytest.mark.parametrize("options", [{}, {"frame": 3, "motion": True, "wet": 0.5, "theme": "country"}])
def test_same_seed_gives_same_bits(options):
    one, two = simulate(3, **options), simulate(3, **options)
    assert one.source.startswith("simulated scan 3")
    assert same(one, two)


def test_global_randomness_is_neither_used_nor_changed():
    np.random.seed(0)  # noqa: NPY002
    torch.manual_seed(0)
    before = np.random.get_state()[1].copy(), torch.get_rng_state()  # noqa: NPY002
    simulate(1)
    assert np.array_equal(before[0], np.random.get_state()[1])  # noqa: NPY002
    assert torch.equal(before[1], torch.get_rng_state())


def test_other_seed_gives_another_street(sensor):
    one, two = (project(street(seed), sensor) for seed in (0, 1))
    both = one.return_mask & two.return_mask
    assert ((one.range_m - two.range_m).abs()[both] > 0.5).float().mean() > 0.2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seed": -1}, "the seed -1"),
        ({"frame": -1}, "the frame -1"),
        ({"frame": 10**9}, "the frame 1000000000"),
        ({"wet": 1.5}, "wet 1.5"),
        ({"wet": float("nan")}, "wet nan"),
    ],
)
def test_what_makes_no_sense_is_refused(options, message):
    with pytest.raises(ConfigError, match=message):
        simulate(**{"seed": 0, **options})


@pytest.mark.parametrize("seed", range(3))
def test_firing_order_unfolds_to_the_rings(seed):
    scan = street(seed)
    assert np.array_equal(rings_from_firing_order(scan.points_xyz_m.numpy().T.copy()), scan.ring.numpy())
    assert scan.ring.unique().tolist() == list(range(64))


@pytest.mark.parametrize("name", ["hdl64e_kitti_odometry", "os1_64", "vlp16"])
def test_every_point_has_its_own_pixel(name):
    sensor = load_sensor(name).fine()
    scan, seen = simulate(4, sensor), observe(4, sensor)
    image = project(scan, sensor)
    assert int(image.return_mask.sum()) == len(scan)
    assert np.array_equal(image.return_mask.numpy(), seen.return_mask)
    assert np.allclose(image.range_m.numpy(), seen.range_m, atol=1e-4)
    assert np.array_equal(image.reflectance.numpy(), seen.reflectance)
    away = (
        unproject(image).points_xyz_m - torch.from_numpy(seen.directions * seen.range_m[..., None])[image.return_mask]
    )
    assert (away.norm(dim=1) <= image.range_m[image.return_mask] * np.pi / sensor.width + 1e-3).all()  # half a column


def test_points_carry_label_and_instance(seen, sensor):
    scan, image = simulate(0, sensor.with_columns(1024)), seen[0]
    assert scan.label.dtype == torch.int64
    assert set((scan.label & 0xFFFF).unique().tolist()) <= classes.CLASSES.keys()
    for part, all_pixels in ((scan.label & 0xFFFF, image.label), (scan.label >> 16, image.instance)):
        assert sorted(part.tolist()) == sorted(all_pixels[image.return_mask].tolist())
    cars = (scan.label & 0xFFFF) == classes.CAR
    assert (scan.label[cars] >> 16 > 0).all()


@pytest.mark.parametrize("options", [{}, {"motion": True, "frame": 2}])
def test_kept_columns_are_those_of_the_whole_scan(sensor, options):
    whole, kept = (observe(5, sensor, kept_columns_only=only, **options) for only in (False, True))
    for name in ("clean_range_m", "return_mask", "range_m", "reflectance", "label", "return_probability"):
        assert np.array_equal(getattr(whole, name)[:, ::8], getattr(kept, name)), name
    image = project(simulate(5, sensor, **options), sensor)
    scan = simulate(5, sensor, kept_columns_only=True, **options)
    assert len(scan) == int(image.return_mask.sum())
    assert torch.equal(project(scan, sensor).range_m, image.range_m)


def test_frames_are_a_drive_through_one_street():
    one, two = (observe(0, theme="suburb", frame=frame) for frame in (0, 10))
    assert np.array_equal(poses_of(0, [1.0], theme="suburb")[0], two.sensor_pose)
    way_m = np.linalg.norm(two.sensor_pose[:3, 3] - one.sensor_pose[:3, 3])
    assert 0.5 < way_m < 25

    def standing(s):  # in the scene's frame
        use = (s.label == classes.BUILDING) & (s.clean_range_m > 0)
        points = s.directions[use].astype(np.float64) * s.clean_range_m[use][:, None]
        return points @ s.sensor_pose[:3, :3].T + s.sensor_pose[:3, 3]

    cells = [set(map(tuple, np.floor(standing(s) / 1.0).astype(int))) for s in (one, two)]
    assert len(cells[0] & cells[1]) > 0.4 * min(len(c) for c in cells)
    assert not np.array_equal(one.return_mask, two.return_mask)


def test_motion_bends_the_points_and_only_so():
    still, moving = (observe(0, theme="suburb", motion=motion) for motion in (False, True))
    assert np.array_equal(still.directions, moving.directions)  # in the sensor's own frame
    speed_m_s = np.linalg.norm(observe(0, theme="suburb", frame=1).sensor_pose[:3, 3] - still.sensor_pose[:3, 3]) / 0.1
    both = (still.label == moving.label) & (still.clean_range_m > 0) & (still.clean_range_m < 40)
    apart = np.abs(still.clean_range_m - moving.clean_range_m)
    begun = both & (np.arange(2048) < 1024) & (np.arange(2048) > 1000)  # just left of straight ahead: fired first
    assert np.median(apart[begun]) < 0.05 * speed_m_s / 10 + 0.01
    late = (
        both & (np.arange(2048) >= 1024) & (np.arange(2048) < 1100) & (still.clean_range_m > 15)
    )  # to its right: last
    assert np.quantile(apart[late], 0.9) > 0.02 * speed_m_s


def test_share_of_returns_is_like_kittis(seen):
    share = np.stack([image.return_mask.mean(axis=1) for image in seen])
    assert 0.8 < share.mean() < 0.92  # 20 real scans looked at: 0.84 to 0.87
    assert (share.mean(axis=1) > 0.7).all()
    assert share[:, 56:].mean() < 0.75  # our own car hides a part of the lowest rings


def test_drops_depend_on_material_and_range(seen):
    def lost(use):
        return np.mean(np.concatenate([~s.return_mask[use(s) & ~s.blocked] for s in seen]))

    ground = (classes.ROAD, classes.SIDEWALK, classes.TERRAIN, classes.PARKING, classes.LANE_MARKING)
    far = [
        lost(lambda s, low=low: np.isin(s.label, ground) & (s.clean_range_m > low) & (s.clean_range_m <= low + 20))
        for low in (5, 25, 60)
    ]
    assert far[0] < 0.05
    assert far[0] < far[1] < far[2]
    near_cars = lost(lambda s: np.isin(s.label, (classes.CAR, classes.MOVING_CAR)) & (s.clean_range_m < 25))
    near_houses = lost(lambda s: (s.label == classes.BUILDING) & (s.clean_range_m < 25))
    assert near_cars > 2 * near_houses


def test_numbers_of_the_model_reach_the_scan(sensor):
    def share(**changes):
        return observe(1, sensor, kept_columns_only=True, model=replace(MODEL, **changes)).return_mask.mean()

    assert share(least_power=MODEL.least_power * 10) < share() - 0.05
    assert share(extinction_per_m=0.03) < share() - 0.02


def test_wet_road_returns_less(sensor):
    dry, wet = (observe(0, sensor, wet=wet, kept_columns_only=True) for wet in (0.0, 1.0))
    road = dry.label == classes.ROAD
    assert wet.return_probability[road].mean() < dry.return_probability[road].mean()
    elsewhere = np.isin(dry.label, (classes.VEGETATION, classes.TERRAIN)) & (dry.label == wet.label)
    assert (dry.range_m == wet.range_m)[elsewhere].mean() > 0.97  # but for beams that meet the road as well


def test_reflectance_is_a_share_and_differs_by_material():
    reflectance = street(0).reflectance
    assert float(reflectance.min()) >= 0
    assert float(reflectance.max()) <= 1
    assert float(reflectance.std()) > 0.05
    assert torch.allclose(reflectance * 100, (reflectance * 100).round(), atol=1e-4)


def test_settings_that_cannot_be_simulated_leave_no_folder_behind(tmp_path, capsys):
    for words, message in ((["--wet", "2"], "--wet 2"), (["--frames", "1000000"], "--frames 1000000")):
        assert main(["simulate", str(tmp_path / "out"), "-n", "2", *words]) == 2
        assert f"got {message}; " in capsys.readouterr().err
        assert not (tmp_path / "out").exists()
