"""Set-ups of sensors: bounds, files, what each number does to a scan, what scans tell of them, and their version."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from scipy.special import ndtr, ndtri

from lidargrit.core.errors import ConfigError
from lidargrit.data.datasets import open_dataset
from lidargrit.data.images import Provenance
from lidargrit.scans.fit_sensor import fit_sensor
from lidargrit.scans.sensors import SensorModel, SensorSetup, load_sensor
from lidargrit.scans.surface_patches import SurfacePatches, range_noise, row_readings
from lidargrit.scans.types import RangeImage
from lidargrit.simulator import observe, simulate
from lidargrit.simulator.observation import ObservationConfig, observe_scene
from lidargrit.simulator.power import RaydropModel, range_sigma_m, reflectance
from lidargrit.simulator.setups import PACKAGED, setup_of
from toy_scene import ToyScene, road, wall

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(1024)
ALL_RETURN = RaydropModel(least_power=1e-9, pulse_spread=0.0)


def look(*parts, columns=SENSOR.width, **setup):
    sensor = replace(SENSOR.with_columns(columns), setup=SensorSetup(**setup))
    streams = (np.random.default_rng(seed) for seed in (0, 1))
    return observe_scene(ToyScene(*parts), sensor, *streams, ObservationConfig(model=ALL_RETURN))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"range_sigma_m": -0.01}, r"got range_sigma_m=-0\.01; wanted a number, at least 0, at most 0\.5"),
        ({"range_sigma_m": float("nan")}, "got range_sigma_m=nan"),
        ({"firing_jitter_rad": 0.2}, r"got firing_jitter_rad=0\.2; wanted a number, at least 0, at most 0\.1"),
        ({"pulse_length_m": 0.0}, "got pulse_length_m=0"),
        ({"glass_passes": 1.5}, "got glass_passes=1.5"),
        ({"height_m": 0.0}, "got height_m=0"),
        ({"offset_m": (0.0, 2.0)}, "got offset_m="),
        ({"reading": (0.01,)}, "got reading="),
        ({"reflectance_scale": 0.0}, "got reflectance_scale=0"),
        ({"reflectance_power": 9.0}, "got reflectance_power=9"),
        ({"weak_dimming": 1.5}, "got weak_dimming=1.5"),
        ({"fades_to_m": -1.0}, "got fades_to_m=-1"),
        ({"fades_from_m": 60.0, "fades_to_m": 20.0}, "got fades_from_m=60, fades_to_m=20; wanted a range"),
    ],
)
def test_numbers_out_of_bounds_are_refused(change, message):
    with pytest.raises(ConfigError, match=message):
        SensorSetup(**change)


def test_files_hold_set_ups_and_tell_mistakes_in_one_line(tmp_path):
    file = tmp_path / "mine.json"
    setup = SensorSetup(offset_m=(0.01,) * 64, height_m=2.0)
    file.write_text(json.dumps(replace(SENSOR, setup=setup).to_json()))
    assert load_sensor(str(file)).setup == setup
    assert load_sensor(str(file)).with_columns(256, 4).setup == setup
    assert "setup" not in SENSOR.to_json()
    data = json.loads(file.read_text())
    for entry, got in (
        ({"height_m": 99}, "the set-up of a sensor with height_m=99"),
        ({"offset_m": [0.0] * 32}, "32 values of offset_m in the set-up of the sensor"),
        ({"noise": 1}, "a set-up: no setting is called 'noise'"),
        (3, "a set-up: '3' in place of settings by name"),
    ):
        file.write_text(json.dumps({**data, "setup": entry}))
        with pytest.raises(ConfigError) as refused:
            load_sensor(str(file))
        assert str(refused.value).startswith(f"got {got}")
        assert "\n" not in str(refused.value)
    file.write_text(json.dumps({**data, "elevation_rad": [], "setup": {"offset_m": []}}))
    with pytest.raises(ConfigError, match="got a sensor whose elevation_rad is no table"):
        load_sensor(str(file))


def test_a_set_up_is_the_sensors_own_or_the_packages_or_sampled():
    rng = np.random.default_rng(0)
    own = SensorSetup(height_m=3.0)
    assert setup_of(replace(SENSOR, setup=own), rng) == own
    assert setup_of(SENSOR, rng) == PACKAGED["hdl64e_kitti_odometry"]
    assert len(setup_of(SENSOR, rng).offset_m) == 64
    sampled = [setup_of(load_sensor("os1_128"), np.random.default_rng(seed)) for seed in (1, 1, 2)]
    assert sampled[0] == sampled[1] != sampled[2]
    assert len(sampled[0].offset_m) == 128
    rng = np.random.default_rng(5)
    assert 1 < SensorSetup.sample(rng, 16).glass_scatters < 40
    assert rng.random() == 0.5070681389233913  # as before panes could scatter, so that the rest of a street stays
    drawn = load_sensor("drawn_5")  # made anew
    assert (drawn.range_max_m, drawn.setup.height_m) == pytest.approx((51.843, 1.426), abs=1e-3)
    for seed in range(200):
        SensorSetup.sample(np.random.default_rng(seed), 16)  # refuses itself out of its bounds
    heights_m = [observe(seed, load_sensor("vlp16"), frame=frame).sensor_pose[2, 3] for seed, frame in ((4, 0), (4, 1))]
    assert abs(heights_m[0] - heights_m[1]) < 0.1  # one unit in all frames of a drive


def test_noise_grows_with_range_and_incidence():
    noise = {"range_sigma_m": 0.01, "range_sigma_per_m": 0.001, "footprint_sigma": 0.1}
    for at_m in (10.0, 40.0):
        seen = look(wall(at_m), **noise)
        error_m = (seen.range_m - seen.clean_range_m)[seen.return_mask & (seen.cos_incidence > 0)]
        range_m, cos = (each[seen.return_mask] for each in (seen.clean_range_m.astype(float), seen.cos_incidence))
        depth_m = range_m * 2e-3 * np.sqrt(1 - np.minimum(cos.astype(float), 1) ** 2) / np.maximum(cos, 0.05)
        expected_m = np.sqrt(0.01**2 + (0.001 * range_m) ** 2 + (0.1 * depth_m) ** 2)
        assert (error_m / expected_m).std() == pytest.approx(1, rel=0.03)
        assert expected_m.max() > 1.2 * expected_m.min()
    assert range_sigma_m(np.float32([5]), np.float32([1]), SensorSetup(range_sigma_m=0.02))[0] == pytest.approx(0.02)


def test_offsets_are_the_same_along_a_row():
    offset_m = np.random.default_rng(0).normal(0, 0.02, 64)
    seen = look(wall(10.0), range_sigma_m=0.0, offset_m=tuple(offset_m))
    for row in range(5, 20):
        at = seen.return_mask[row]
        assert np.allclose((seen.range_m - seen.clean_range_m)[row, at], offset_m[row], atol=1e-5)


def test_what_is_farther_than_files_keep_is_lost_and_still_stands_there():
    seen = look(wall(30.0, half_width_m=200.0), farthest_m=50.0)
    assert seen.range_m.max() <= 50
    assert seen.clean_range_m.max() > 60
    assert not seen.return_mask[seen.clean_range_m > 51].any()
    assert not seen.return_probability[seen.clean_range_m > 51].any()


def test_height_and_gaps_and_scale():
    for height_m in (1.5, 2.2):
        seen = look(road(), height_m=height_m)
        assert np.allclose((seen.directions[..., 2] * seen.clean_range_m)[50], -height_m, atol=1e-3)
    jitter_rad = np.pi / SENSOR.width / ndtri(0.85)  # three firings in ten leave columns of this width
    for columns, share in ((SENSOR.width, 0.3), (SENSOR.width // 2, 2 * ndtr(-2 * ndtri(0.85)))):
        wide = look(wall(10.0), columns=columns, firing_jitter_rad=jitter_rad)
        at = (wide.clean_range_m > 0) & ~wide.blocked
        assert wide.return_mask[at].mean() == pytest.approx(1 - share, abs=0.01)
        assert wide.return_probability[at].mean() == pytest.approx(1 - share, abs=0.01)
    plain, dim = (look(wall(10.0), reflectance_scale=scale) for scale in (1.0, 0.25))
    read = plain.return_mask & (plain.reflectance > 0.1) & (plain.reflectance < 0.9)
    assert read.any()
    assert np.allclose(dim.reflectance[read], plain.reflectance[read] / 4, atol=4e-3)  # 255ths


def read_as(scattered, level, range_m=10.0, **setup):
    ones = np.ones_like(np.asarray(scattered, np.float32))
    given = ones * np.float32(scattered), 0 * ones, ones * np.float32(level), 0 * ones, ones * np.float32(range_m)
    return reflectance(*given, RaydropModel(), SensorSetup(**setup))


def test_weak_echoes_read_darker_by_as_much_as_the_set_up_says():
    model = RaydropModel()
    for level, share in (
        (model.dim_level - 1, 0.0),
        ((model.dim_level + model.bright_level) / 2, (1 + model.dim_share) / 2),
        (model.bright_level + 1, 1.0),
    ):
        for dimming in (0.0, 0.4, 1.0):
            read = read_as([0.8], level, reflectance_scale=0.5, weak_dimming=dimming)
            assert read == pytest.approx(0.4 * (1 - dimming * (1 - share)), abs=0.003)


def test_contrast_and_fading_of_readings():
    scattered, strong = np.linspace(0.05, 0.9, 30), 9.0
    assert read_as(scattered, strong, reflectance_scale=0.9, reflectance_power=2.5) == pytest.approx(
        0.9 * scattered**2.5, abs=0.003
    )
    for range_m, share in ((10, 1), (20, 1), (30, 0.75), (50, 0.25), (70, 0)):
        read = read_as(scattered, strong, range_m, fades_from_m=20.0, fades_to_m=60.0)
        assert read == pytest.approx(scattered * share, abs=0.006)


def test_far_roads_of_a_pandar64_read_as_near_ones():
    readings = []
    for low_m, high_m in ((4, 12), (30, 50)):
        seen = observe(1, load_sensor("pandar64"))
        at = seen.return_mask & (seen.label == 40) & (seen.range_m > low_m) & (seen.range_m < high_m)
        readings.append(np.median(seen.reflectance[at]))
    assert readings[1] == pytest.approx(readings[0], rel=0.3)


def test_scans_tell_the_set_up_that_made_them():
    offset_m = 0.03 * np.random.default_rng(1).standard_normal(64)
    reading = np.where(np.arange(64) % 7 == 3, 0.7, 1.0)
    setup = SensorSetup(
        range_sigma_m=0.015, offset_m=tuple(offset_m), reading=tuple(reading), height_m=2.0, reflectance_scale=0.5
    )
    scans = [simulate(seed, replace(SENSOR, setup=setup)) for seed in range(4)]
    fit = fit_sensor(scans)
    found = fit.sensor.setup
    assert found is not None
    assert found.range_sigma_m == pytest.approx(0.015, abs=0.002)
    assert found.height_m == pytest.approx(2.0, abs=0.06)
    assert np.corrcoef(found.offset_m, offset_m)[0, 1] > 0.9
    assert np.corrcoef(found.reading, reading)[0, 1] > 0.9
    assert 0.3 < found.reflectance_scale < 0.7
    again = SensorModel.from_json(json.loads(json.dumps(fit.sensor.to_json())))
    assert again.setup == found


def test_patches_of_nothing_tell_nothing():
    nothing = RangeImage(torch.zeros(64, 1024), torch.zeros(64, 1024, dtype=torch.bool), SENSOR)
    assert range_noise([nothing]) is None
    assert row_readings([nothing]) is None
    few = load_sensor("vlp16").with_columns(4)
    image = RangeImage(torch.full((16, 4), 5.0), torch.ones(16, 4, dtype=torch.bool), few)
    assert len(SurfacePatches.of(image).row) == 0


def test_provenance_tells_the_version_of_the_streets():
    streets = open_dataset("simulated:2")
    assert Provenance(recordings=(streets.recording(0),)).streets == ("streets 4",)
    assert Provenance(recordings=("simulated/seed_0000000", "a/b")).streets == ("streets 1",)
    assert Provenance(recordings=("kitti/00",)).streets == ()


def test_every_number_of_a_set_up_is_described():
    for each in fields(SensorSetup):
        assert each.name in (SensorSetup.__doc__ or "")
