"""Figures that tell simulated scans from real ones, against slow loops, SciPy and surfaces whose value is known."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import chi2

from lidargrit.evaluation.street_figures import (
    StreetFigures,
    column_distances_m,
    figures_table,
    ground_heights_m,
    jumps_with_a_drop,
)
from lidargrit.scans.classes import BUILDING, CAR, LANE_MARKING, ROAD
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.surface_patches import plane_residuals, row_offsets
from lidargrit.scans.types import RangeImage

SENSOR = load_sensor("hdl64e_kitti_odometry")
HEIGHT_M, WALL_M = 1.73, 8.0


def street(noise_m=0.0, offset_m=None, seed=0, drop_share=0.0):
    """Level ground below, and a wall on either side that runs ahead."""
    rng = np.random.default_rng(seed)
    directions = SENSOR.ray_directions().double().numpy()
    to_ground = HEIGHT_M / np.maximum(-directions[..., 2], 1e-9)
    to_wall = WALL_M / np.maximum(np.abs(directions[..., 1]), 1e-9)
    range_m = np.minimum(to_ground, to_wall)
    mask = (range_m < 60) & (rng.random(range_m.shape) >= drop_share)
    range_m = range_m + noise_m * rng.standard_normal(range_m.shape)
    if offset_m is not None:
        range_m = range_m + offset_m[:, None]
    pixels = torch.from_numpy(range_m).float().clamp(0.9, 120)
    return RangeImage.stack([RangeImage.masked(pixels, torch.from_numpy(mask), SENSOR)])


def offsets_of_lasers(seed=1):
    """Offsets without what neighbouring rows share, which no plane tells."""
    offset_m = 0.03 * np.random.default_rng(seed).standard_normal(SENSOR.height)
    return offset_m - np.convolve(np.pad(offset_m, 4, "edge"), np.ones(9) / 9, "valid")


def slow_columns(image):
    """Fit a line to every run by a singular value decomposition."""
    xyz_m = (SENSOR.ray_directions() * image.range_m[0, ..., None]).double().numpy()
    range_m, mask = image.range_m[0].double().numpy(), image.return_mask[0].numpy()
    found = []
    for column in range(SENSOR.width):
        for row in range(SENSOR.height - 9):
            run = slice(row, row + 10)
            if not mask[run, column].all():
                continue
            near, far = (np.sort([range_m[run, column][:-1], range_m[run, column][1:]], axis=0)[at] for at in (0, 1))
            distance_m, up_m = np.hypot(*xyz_m[run, column, :2].T), xyz_m[run, column, 2]
            if (far - near > 0.1 * far).any() or abs(up_m[0] - up_m[-1]) <= 2 * abs(distance_m[0] - distance_m[-1]):
                continue
            points = np.stack((distance_m, up_m), axis=1)
            found.append(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] / math.sqrt(10))
    return found


def test_columns_of_walls_against_a_slow_loop():
    image = street(0.05, seed=3, drop_share=0.05)
    found, slow = column_distances_m(image).sort().values, sorted(slow_columns(image))
    assert len(slow) > 500
    assert np.allclose(found.numpy(), slow, atol=1e-6)


def test_a_sensor_of_four_rows_has_all_figures_but_that_of_ten_rows():
    sensor = replace(load_sensor("vlp16").with_columns(64), elevation_rad=SENSOR.elevation_rad[:4])
    range_m = torch.full((1, 4, 64), 20.0)
    figures = StreetFigures.of([RangeImage(range_m, range_m > 0, sensor)])
    assert "10 rows of a column, walls" not in figures.pooled
    assert figures.pooled["returns, rows 15 to 31 of 64"] == 100


def test_noise_on_walls_is_that_of_chi_squared_distributions():
    """Rows fit two numbers to 8 returns, columns two to 10; both see the noise at right angles to the line."""
    figures = StreetFigures.of([street(0.02, seed=seed) for seed in range(4)])
    rows_cm, columns_cm = (figures.pooled[f"{name}, walls"] for name in ("noise along a row", "10 rows of a column"))
    assert rows_cm < 2 * math.sqrt(chi2.ppf(0.25, 6) / 8)  # where a wall is struck at an angle, it is less
    expected = np.quantile(np.concatenate([column_distances_m(street(0.02, seed=seed)) for seed in range(4)]), 0.25)
    assert math.isclose(columns_cm, 100 * expected, rel_tol=1e-5)
    assert math.isclose(columns_cm, 2 * math.sqrt(chi2.ppf(0.25, 8) / 10), rel_tol=0.05)
    twice = StreetFigures.of([street(0.04, seed=seed) for seed in range(4)]).pooled["noise along a row, walls"]
    assert math.isclose(twice, 2 * rows_cm, rel_tol=0.05)


def test_an_offset_of_each_laser_shows_along_a_column_and_not_along_a_row():
    offset_m = offsets_of_lasers()
    plain, shifted = (StreetFigures.of([street(0.005, offset)]) for offset in (None, offset_m))
    ratio = [
        shifted.pooled[f"{name}, walls"] / plain.pooled[f"{name}, walls"]
        for name in ("noise along a row", "10 rows of a column")
    ]
    assert ratio[0] < 1.1
    assert ratio[1] > 3
    assert np.nanstd(shifted.offset_m) > 5 * np.nanstd(plain.offset_m)
    assert shifted.correlation(StreetFigures.of([street(0.005, offset_m, seed=5)])) > 0.95
    assert abs(shifted.correlation(StreetFigures.of([street(0.005, offsets_of_lasers(2))]))) < 0.5


def test_residuals_of_planes_against_a_slow_loop():
    image = street(0.02, offsets_of_lasers(), drop_share=0.02)[0]
    directions = SENSOR.ray_directions().double().numpy()
    residuals = [[] for _ in range(SENSOR.height)]
    for row in range(SENSOR.height - 8):
        for column in range(0, SENSOR.width - 4, 5):
            at = slice(row, row + 9), slice(column, column + 5)
            if not image.return_mask[at].all():
                continue
            range_m, rays = image.range_m[at].double().numpy().ravel(), directions[at].reshape(-1, 3)
            if range_m.max() > 3 * range_m.min() or range_m.max() > 40:
                continue
            normal = np.linalg.lstsq(rays, 1 / range_m)[0]
            off_m = range_m - 1 / (rays @ normal)
            if np.sqrt((off_m**2).mean()) <= 0.1 and np.linalg.norm(normal) * range_m.mean() <= 1 / 0.15:
                for step in range(9):
                    residuals[row + step] += off_m.reshape(9, 5)[step].tolist()
    slow = [np.median(each) if len(each) >= 50 else np.nan for each in residuals]
    assert np.isfinite(slow).sum() > 40
    assert np.allclose(plane_residuals(image), slow, atol=1e-7, equal_nan=True)


def test_offsets_that_were_added_are_found_again():
    offset_m = offsets_of_lasers()
    found = row_offsets([street(0.005, offset_m, seed=seed)[0] for seed in range(3)])
    known = found != 0
    assert known.sum() > 50
    assert np.corrcoef(found[known], offset_m[known])[0, 1] > 0.97
    assert np.std(found[known] - offset_m[known]) < 0.25 * np.std(offset_m[known])
    assert np.abs(row_offsets([street()[0]])).max() < 1e-3


def test_jumps_against_a_slow_loop():
    rng = np.random.default_rng(0)
    range_m, mask = rng.choice([5.0, 6.0, 9.0], (2, 64, 256)), rng.random((2, 64, 256)) < 0.4
    mask[0, 3], mask[1, 7, 1:] = False, False  # a row without a return, and one with a single return
    images = RangeImage.masked(torch.from_numpy(range_m).float(), torch.from_numpy(mask), SENSOR)
    slow = []
    for which, row in np.ndindex(2, 64):
        at = np.flatnonzero(mask[which, row])
        for here, after in zip(at, np.roll(at, -1), strict=True):
            between = (after - here - 1) % 256
            if between <= 4 and abs(range_m[which, row, here] - range_m[which, row, after]) > 1.5:
                slow.append(between > 0)
    found = jumps_with_a_drop(images)
    assert len(slow) > 1000
    assert (len(found), int(found.sum())) == (len(slow), sum(slow))
    assert len(jumps_with_a_drop(RangeImage.masked(images.range_m, images.return_mask & False, SENSOR))) == 0


def test_heights_of_the_ground_are_those_of_the_plane():
    heights_m = ground_heights_m(street())
    assert len(heights_m) > 1000
    assert float(((heights_m + HEIGHT_M).abs() < 1e-4).double().mean()) > 0.95  # few runs end on a wall
    slope = 0.03  # uphill straight ahead
    directions = SENSOR.ray_directions().double()
    range_m = HEIGHT_M / (slope * directions[..., 0] - directions[..., 2]).clamp(min=1e-3)
    tilted = RangeImage.stack([RangeImage.masked(range_m.float(), range_m < 119, SENSOR)])
    ahead_m = (directions[..., 0] * range_m)[2:]
    spread_m = StreetFigures.of([tilted]).pooled["height of level ground, 10 to 90 %"]
    rows = (slope * ahead_m - HEIGHT_M)[range_m[2:] < 50]
    rows = rows[rows < -1]
    assert math.isclose(spread_m, float(rows.quantile(0.9) - rows.quantile(0.1)), rel_tol=0.05)


def test_shares_and_classes_pooled_and_over_scans():
    rng = np.random.default_rng(1)
    images = []
    for returned in (0.2, 0.9, 0.8):
        mask = torch.from_numpy(rng.random((1, 64, 256)) < returned)
        range_m = torch.from_numpy(rng.uniform(1, 119, (1, 64, 256))).float()
        label = torch.from_numpy(rng.choice([0, CAR, ROAD, LANE_MARKING, BUILDING], (1, 64, 256)))
        images.append(RangeImage.masked(range_m, mask, SENSOR, {"label": label}))
    figures = StreetFigures.of([RangeImage.cat(images[:2]), images[2]])
    ranges = [image.range_m[image.return_mask].double().numpy() for image in images]
    labels = [image.label[image.return_mask].numpy() for image in images]
    for far_m in (60, 80):
        shares = [float((each > far_m).mean()) for each in ranges]
        assert math.isclose(figures.over_scans[f"returns beyond {far_m} m"], 100 * np.median(shares))
        pooled = (np.concatenate(ranges) > far_m).mean()
        assert math.isclose(figures.pooled[f"returns beyond {far_m} m"], 100 * pooled)
    rows = [float(image.return_mask[:, 15:32].double().mean()) for image in images]
    assert math.isclose(figures.over_scans["returns, rows 15 to 31 of 64"], 100 * np.median(rows))
    roads = [np.isin(each, (ROAD, LANE_MARKING)) for each in labels]
    assert math.isclose(figures.pooled["road, share of returns"], 100 * np.concatenate(roads).mean())
    middles = [np.median(each[road]) for each, road in zip(ranges, roads, strict=True)]
    assert math.isclose(figures.over_scans["road, median range"], np.median(middles))
    assert "person, cycle, median range" not in figures.pooled
    assert figures.num_scans == 3


def test_the_table_has_pooled_values_and_medians_over_scans():
    sets = {name: StreetFigures.of([street(noise_m)]) for name, noise_m in (("simulated", 0.02), ("real", 0.01))}
    table = figures_table(sets)
    assert table.head == ("all scans (median over scans)", "simulated", "real")
    rows = {row[0]: row[1:] for row in table.rows}
    assert rows["scans"] == ("1", "1")
    assert rows["returns beyond 80 m [%]"] == ("0 (0)", "0 (0)")
    assert rows["offsets of rows, correlation"][1] == ""
    assert not any("share" in name for name in rows)  # no labels


@pytest.mark.parametrize("sensor", ["vlp16", "os1_128"])
def test_sensors_of_other_rows_are_measured(sensor):
    rays = load_sensor(sensor)
    image = RangeImage.masked(
        torch.full((2, rays.height, rays.width), 5.0), torch.ones(2, rays.height, rays.width) > 0, rays
    )
    figures = StreetFigures.of([image])
    assert figures.pooled["returns, rows 15 to 31 of 64"] == 100
    assert figures.to_json()["scans"] == 2
