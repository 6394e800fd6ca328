"""Errors of forecasts and of drives, each against an independent computation, and both protocols of drives."""

import json
import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from lidargrit.cli import main
from lidargrit.core.errors import ConfigError, DataError
from lidargrit.data.drives import DriveConfig, write_drives
from lidargrit.evaluation.drive_errors import (
    chamfer_m2,
    consistency_chamfer_m2,
    consistency_error_m,
    forecast_errors,
    gem_errors,
    registered,
)
from lidargrit.evaluation.drives import baselines, constant_speed, evaluate_forecast
from lidargrit.evaluation.evaluate import EvalConfig
from lidargrit.scans.past import Past
from lidargrit.scans.sensors import SensorModel, column_azimuths_rad, load_sensor

TINY = SensorModel(
    "tiny", torch.tensor([0.1, 0.0, -0.1, -0.2])[:, None], column_azimuths_rad(16), 1.0, 120.0, "spherical"
)


def slow_chamfer_m2(one: np.ndarray, other: np.ndarray) -> float:
    apart = ((one[:, None] - other[None]) ** 2).sum(-1)
    return (apart.min(1).mean() + apart.min(0).mean()) / 2


def test_errors_of_a_forecast_are_those_of_a_slow_loop():
    rng = np.random.default_rng(0)
    true, forecast = rng.uniform(2, 90, (2, 4, 16))
    true[rng.random((4, 16)) < 0.2], forecast[rng.random((4, 16)) < 0.3] = 0, 0
    found = forecast_errors(torch.from_numpy(forecast), torch.from_numpy(true), TINY)
    rays = TINY.ray_directions().double().numpy()
    told = [pixel for pixel in np.ndindex(4, 16) if forecast[pixel] > 0]
    off, relative, both, boxed = [], [], [], {"true": [], "forecast": []}
    for pixel in np.ndindex(4, 16):
        for name, ranges in (("true", true), ("forecast", forecast)):
            x, y, z = ranges[pixel] * rays[pixel]
            inside = ranges[pixel] > 0 and abs(x) <= 70 and abs(y) <= 70 and abs(z) <= 4.5
            boxed[name] += [ranges[pixel] * rays[pixel]] * int(inside)
            if name == "true" and inside:
                nearest = max(told, key=lambda other, pixel=pixel: float(rays[other] @ rays[pixel]))
                off.append(abs(forecast[nearest] - true[pixel]))
                relative.append(off[-1] / true[pixel])
        if forecast[pixel] > 0 and true[pixel] > 0:
            both.append(abs(forecast[pixel] - true[pixel]))
    assert 10 < len(off) < (true > 0).sum()
    assert found.l1_m == pytest.approx(np.mean(off))
    assert found.abs_rel == pytest.approx(np.mean(relative))
    assert found.median_m == pytest.approx(np.median(both))
    assert found.covered == pytest.approx(len(both) / (true > 0).sum())
    assert found.mask_right == pytest.approx(((true > 0) == (forecast > 0)).mean())
    assert found.chamfer_m2 == pytest.approx(slow_chamfer_m2(*map(np.array, boxed.values())))


def test_a_forecast_of_nothing_and_a_perfect_one_have_the_errors_that_they_should():
    true = torch.full((4, 16), 10.0).double()
    perfect, nothing = forecast_errors(true, true, TINY), forecast_errors(torch.zeros_like(true), true, TINY)
    assert (perfect.l1_m, perfect.median_m, perfect.covered, perfect.mask_right, perfect.chamfer_m2) == (0, 0, 1, 1, 0)
    assert (nothing.l1_m, nothing.abs_rel, nothing.covered, nothing.mask_right) == (10, 1, 0, 0)
    assert math.isnan(nothing.median_m)
    assert chamfer_m2(np.zeros((0, 3)), np.ones((2, 3))) == 0


def points_of_gem(range_m: np.ndarray) -> np.ndarray:
    """Points as to_xyz writes them, pixel by pixel: on the upper and first edges, at the sensor without a return."""
    height, width = range_m.shape
    points = []
    for row, column in np.ndindex(height, width):
        pitch, yaw = math.radians(3 - 28 * row / height), math.radians(180 - 360 * column / width)
        flat = range_m[row, column] * math.cos(pitch)
        points.append((flat * math.cos(yaw), flat * math.sin(yaw), range_m[row, column] * math.sin(pitch)))
    return np.array(points)


@pytest.mark.parametrize(("true_drops", "forecast_drops"), [(0.2, 0.3), (0, 0.3), (0.2, 0), (0.2, 1), (1, 0.2)])
def test_gems_chamfer_distance_is_that_of_all_pixels_with_drops_at_the_sensor(true_drops, forecast_drops):
    rng = np.random.default_rng(2)
    rows = torch.deg2rad(3 - 28 * (torch.arange(8) + 0.5) / 8)[:, None]
    few = SensorModel("few", rows, column_azimuths_rad(32), 1.45, 80.0, "spherical")
    true, forecast = rng.uniform(2, 79, (2, 8, 32))
    true[rng.random((8, 32)) < true_drops], forecast[rng.random((8, 32)) < forecast_drops] = 0, 0
    found = gem_errors(torch.from_numpy(forecast), torch.from_numpy(true), few)
    clouds = [points_of_gem(range_m) for range_m in (forecast, true)]
    assert found.chamfer_m2 == pytest.approx(slow_chamfer_m2(*clouds))
    inner = [cloud[np.all(np.abs(cloud) <= (70, 70, 4.5), axis=1)] for cloud in clouds]
    assert found.inner_m2 == pytest.approx(slow_chamfer_m2(*inner))
    alone = [cloud[np.linalg.norm(cloud, axis=1) > 0] for cloud in clouds]
    assert found.returns_m2 == pytest.approx(slow_chamfer_m2(*alone) if all(map(len, alone)) else 0)
    assert found.drops == (true == 0).mean()
    if (true_drops, forecast_drops) == (0.2, 0.3):
        assert found.chamfer_m2 < 0.9 * found.returns_m2, "what the fault is worth"


def room(count: int = 1500) -> np.ndarray:
    """Return points on four walls and a floor."""
    rng = np.random.default_rng(1)
    points = rng.uniform((-12, -9, -2), (12, 9, 3), (count, 3))
    side = rng.integers(0, 5, count)
    points[side == 0, 0], points[side == 1, 0], points[side == 2, 1], points[side == 3, 1] = 12, -12, 9, -9
    points[side == 4, 2] = -2
    return points


def test_registration_finds_a_small_motion_as_a_general_minimiser_does():
    source, turn = room(), Rotation.from_euler("z", 0.02)
    target = turn.apply(source) + np.array([0.25, -0.1, 0.02])
    found = registered(source, target)
    assert np.allclose(found[:3, 3], (0.25, -0.1, 0.02), atol=1e-6)

    def squared_m2(parameters: np.ndarray) -> float:
        moved = Rotation.from_rotvec(parameters[:3]).apply(source) + parameters[3:]
        return ((moved - target) ** 2).sum(1).mean()

    other = minimize(squared_m2, np.zeros(6)).x
    assert np.allclose(Rotation.from_matrix(found[:3, :3]).as_rotvec(), other[:3], atol=1e-4)
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = turn.as_matrix(), (0.25, -0.1, 0.02)
    assert consistency_error_m(source, target, transform) < 1e-6
    wrong = transform + np.array([[0, 0, 0, 0.3], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]])
    assert consistency_error_m(source, target, wrong) == pytest.approx(0.1, abs=1e-6)
    assert consistency_chamfer_m2(source, target, transform) == pytest.approx(0, abs=1e-12)
    at_sensor = np.vstack((source, [[0.1, 0, 0]]))  # left out
    here = slow_chamfer_m2(source @ wrong[:3, :3].T + wrong[:3, 3], target)
    assert consistency_chamfer_m2(at_sensor, target, wrong) == pytest.approx(here)


def test_at_constant_speed_the_past_keeps_to_a_steady_motion_and_departs_from_another():
    step = torch.eye(4).double()
    step[:3, :3] = torch.from_numpy(Rotation.from_euler("z", 0.03).as_matrix())
    step[0, 3] = -0.8
    steady = torch.stack([torch.linalg.matrix_power(step, 4 - at) for at in range(3)])[None]
    past = Past(torch.rand(1, 3, 4, 16) + 5, steady, torch.tensor([[0.4, 0.3, 0.2]]).double(), TINY)
    torch.testing.assert_close(constant_speed(past, 2).transforms, steady)
    assert list(baselines(past, 2)) == ["copied", "warped", "warped_cache", "warped_cache, constant speed"]


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """One street of seven scans by few columns."""
    folder = tmp_path_factory.mktemp("drives")
    sensor = load_sensor("hdl64e_kitti_odometry").with_columns(128)
    write_drives(folder, 7, DriveConfig(sensor, seed=2_000_003, frames=7))
    return folder


def test_drives_are_scored_from_the_command_line(drives, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("LIDARGRIT_CACHE", str(tmp_path / "cache"))
    columns = ["--set", "data.columns=128", "data.column_stride=4"]
    file = str(tmp_path / "scores.json")
    assert main(["evaluate", str(drives), "--protocol", "forecast", "--json", file, *columns]) == 0
    (near,) = json.loads((tmp_path / "scores.json").read_text())["horizons"]
    assert (near["horizon_s"], near["scans"] + near["standing"]) == (0.1, 2)
    copied, warped = near["forecasts"]["copied"], near["forecasts"]["warped"]
    assert warped["l1_m"]["value"] < copied["l1_m"]["value"]
    assert "3 s ahead: no drive of" in capsys.readouterr().out
    assert main(["evaluate", str(drives), str(drives), "--protocol", "drive", "-n", "1", *columns]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:4] == ["drives", "scans", "TTCE", "3"]
    assert lines[1] == lines[2]


def test_what_cannot_be_forecast_is_told(drives, tmp_path, monkeypatch):
    monkeypatch.setenv("LIDARGRIT_CACHE", str(tmp_path / "cache"))
    with pytest.raises(ConfigError, match="pretrained/lidargrit, which takes no past"):
        evaluate_forecast(str(drives), EvalConfig("forecast"), "pretrained/lidargrit")
    with pytest.raises(DataError, match="none follows another in a drive"):
        evaluate_forecast("simulated:2:test", EvalConfig("forecast"))
