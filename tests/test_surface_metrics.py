"""Edges, thin objects, flying points and walls: against slow loops, and on scenes whose answer is known."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.distance import jensenshannon

from lidargrit.evaluation.metrics import load_metric
from lidargrit.evaluation.metrics import wall_straightness as walls
from lidargrit.scans.projection import points_of_pixels
from lidargrit.scans.sensors import SensorModel, column_azimuths_rad
from lidargrit.scans.types import RangeImage

SENSOR = SensorModel("small", torch.linspace(0.05, -0.3, 16)[:, None], column_azimuths_rad(96), 1.0, 100.0, "spherical")
GAPS_M = np.geomspace(1.0, 64.0, 13)
OFF_M = np.geomspace(1e-3, 1.0, 25)


def street(seed, count=4, noise_m=0.02, drop_share=0.05):
    """Ground, and two house fronts that run past the sensor with gaps to what is behind them."""
    rng = torch.Generator().manual_seed(seed)
    shape = (count, SENSOR.height, SENSOR.width)
    azimuth, elevation = SENSOR.azimuth_rad.double(), SENSOR.elevation_rad.double()
    ground_m = 1.73 / torch.sin(-elevation.clamp(max=-1e-3))
    front_m = torch.where(azimuth.sin() > 0, 6.0, 9.0) / azimuth.sin().abs().clamp(min=0.02) / elevation.cos()
    behind = (torch.rand(count, 1, 24, generator=rng) < 0.3).repeat_interleave(4, dim=2)
    fronts_m = front_m.expand(shape) + torch.where(behind, 8.0, 0.0)
    range_m = torch.minimum(ground_m.expand(shape), fronts_m)
    range_m = range_m + noise_m * torch.randn(shape, generator=rng, dtype=torch.float64)
    mask = (torch.rand(shape, generator=rng) > drop_share) & (range_m < 100) & (range_m > 1)
    return RangeImage.masked(range_m.float(), mask, SENSOR)


def smeared(images, share, seed=0):
    """Move a share of the returns to the middle between their neighbours, as a decoder does at edges."""
    rng = torch.Generator().manual_seed(seed)
    middle_m = (images.range_m.roll(1, -1) + images.range_m.roll(-1, -1)) / 2
    both = images.return_mask.roll(1, -1) & images.return_mask.roll(-1, -1)
    chosen = both & (torch.rand(images.range_m.shape, generator=rng) < share)
    return RangeImage.masked(torch.where(chosen, middle_m, images.range_m), images.return_mask, SENSOR)


def score(name, generated, real):
    metric = load_metric(name)()
    metric.update(generated, real=False)
    metric.update(real, real=True)
    return metric.compute()


def slow_flying_points(images):
    """Tried and happened in every bin of gap width, pixel by pixel."""
    counts = np.zeros((2, 12), dtype=int)

    def surface(row, column, side):
        one, two = row[(column + side) % len(row)], row[(column + 2 * side) % len(row)]
        if not (one and two) or abs(1 / one - 1 / two) > 0.1 * max(1 / one, 1 / two):
            return None
        return 1 / (2 / one - 1 / two) if 2 / one > 1 / two else None

    for row in images.range_m.double().flatten(0, 1).tolist():
        for column, range_m in enumerate(row):
            sides = surface(row, column, -1), surface(row, column, 1)
            if not range_m or None in sides:
                continue
            near, far = sorted(sides)
            gap = np.searchsorted(GAPS_M, far - near, side="right") - 1
            if 0 <= gap < 12:
                counts[0, gap] += 1
                counts[1, gap] += near + 0.3 < range_m < far - 0.3
    return counts


def slow_distances(images):
    """Distances from a line, by a singular value decomposition of every run."""
    found = []
    for points, mask in zip(points_of_pixels(images).double().numpy(), images.return_mask.numpy(), strict=True):
        height, width = mask.shape
        range_m = np.linalg.norm(points, axis=-1)

        def mean(row, run):
            kept = [column for column in run if mask[row, column]]  # noqa: B023
            if len(kept) < 4:
                return None
            xyz = points[row, kept]  # noqa: B023
            return np.hypot(xyz[:, 0], xyz[:, 1]).mean(), xyz[:, 2].mean()

        for row in range(height):
            for start in range(width):
                run = [(start + k) % width for k in range(8)]
                if not mask[row, run].all():
                    continue
                pairs = zip(range_m[row, run], range_m[row, run[1:]], strict=False)
                if any(abs(a - b) > 0.1 * max(a, b) for a, b in pairs):
                    continue
                here, others = mean(row, run), [mean(r, run) for r in (row - 1, row + 1) if 0 <= r < height]
                if any(o and abs(o[1] - here[1]) > abs(o[0] - here[0]) for o in others):
                    xy = points[row, run, :2]
                    found.append(np.linalg.svd(xy - xy.mean(axis=0))[1][1] / math.sqrt(8))
    return np.array(found)


@pytest.mark.parametrize("make", [street, lambda s: smeared(street(s), 0.3), lambda s: street(s, 4, 1.0)])
def test_flying_points_are_those_of_a_slow_loop(make):
    images = make(0)
    counted = load_metric("flying_points")().count(images)
    assert np.abs(counted - slow_flying_points(images)).sum() <= 2  # single precision, at the limits
    assert counted[0].sum() > 50


def test_the_distance_of_flying_points_is_that_of_coins():
    generated, real = smeared(street(0, 40), 0.3), street(1, 40)
    result = score("flying_points", generated, real)
    shares = [np.array(result.details[which], dtype=float) for which in ("generated", "real")]
    pairs = [(p, q) for p, q in zip(*shares, strict=True) if not np.isnan(p)]
    apart = np.mean([jensenshannon([p, 1 - p], [q, 1 - q], base=2) ** 2 for p, q in pairs])
    assert len(pairs) >= 2
    assert result.value == pytest.approx(math.sqrt(apart), rel=1e-9)


def test_only_returns_between_two_surfaces_fly():
    flying = load_metric("flying_points")()
    edges, flies = flying.count(street(0, noise_m=0.0)).sum(axis=1)
    assert edges > 50
    assert flies < 0.05 * edges
    plane_m = (5.0 / SENSOR.azimuth_rad.sin().clamp(min=0.02)).expand(1, 16, 96).contiguous()
    plane = RangeImage.masked(plane_m, plane_m < 100, SENSOR)
    assert flying.count(plane)[1].sum() == 0  # a wall that is struck at every angle
    wall_m = torch.full((1, 16, 96), 10.0)
    wall_m[..., 40:] = 20.0
    for range_m, flies in ((10.2, 0), (10.4, 1), (15.0, 1), (19.6, 1), (19.8, 0), (25.0, 0), (5.0, 0)):
        wall_m[..., 40] = range_m
        counts = flying.count(RangeImage(wall_m, wall_m > 0, SENSOR)).sum(axis=1)
        assert counts[1] == 16 * flies, range_m
    assert (
        score("flying_points", smeared(street(0), 0.3), street(1)).value
        > score("flying_points", street(0), street(1)).value
    )


@pytest.mark.parametrize("images", [street(0), street(1, noise_m=0.3), smeared(street(2), 0.5)])
def test_distances_from_a_line_are_those_of_a_slow_loop(images):
    slow = slow_distances(images)
    counts = load_metric("wall_straightness")().count(images)
    assert len(slow) > 100
    expected = np.histogram(np.clip(slow, OFF_M[0], OFF_M[-1]), OFF_M)[0]
    assert np.array_equal(counts, expected)


def test_the_distance_of_straightness_is_scipys():
    generated, real = street(0, noise_m=0.05), street(1)
    counts = [load_metric("wall_straightness")().count(images) for images in (generated, real)]
    expected = jensenshannon(*(each / each.sum() for each in counts), base=2)
    assert score("wall_straightness", generated, real).value == pytest.approx(float(expected), rel=1e-9)


def test_noise_shows_as_distance_from_the_line_and_ground_does_not_count():
    for noise_m in (0.01, 0.05):
        off_m = slow_distances(street(0, noise_m=noise_m))
        assert np.median(off_m) == pytest.approx(noise_m, rel=0.5)
    ground_m = (1.73 / torch.sin(-SENSOR.elevation_rad.clamp(max=-0.02))).expand(1, 16, 96).contiguous()
    ground = RangeImage.masked(ground_m, ground_m < 50, SENSOR)
    assert load_metric("wall_straightness")().count(ground).sum() == 0


def test_a_line_at_any_angle_is_straight():
    along = torch.linspace(-3, 3, 96).double()[None, None]
    for angle in (0.0, 0.7, math.pi / 2):
        x, y = 20 + along * math.cos(angle), -5 + along * math.sin(angle)
        off_m = walls.distance_from_line(x, y)[..., :-8]
        assert float(off_m.max()) < 1e-6
    corner = np.stack((along[0, 0, 44:52], along[0, 0, 44:52].abs()), axis=1)
    off_m = float(walls.distance_from_line(along, along.abs())[0, 0, 44])
    assert off_m == pytest.approx(np.linalg.svd(corner - corner.mean(axis=0))[1][1] / math.sqrt(8))


def slow_edges(images, edges_m):
    """Pairs of returns side by side, and those on two surfaces, in bins of the nearer range."""
    counts = np.zeros((2, 24), dtype=int)
    for row, returned in zip(images.range_m.flatten(0, 1).tolist(), images.return_mask.flatten(0, 1), strict=True):
        for column, one_m in enumerate(row):
            beside = (column + 1) % len(row)
            if returned[column] and returned[beside]:
                near_m, far_m = sorted((one_m, row[beside]))
                at = np.searchsorted(edges_m, near_m, side="right") - 1
                counts[:, at] += (1, far_m - near_m > 0.1 * far_m)
    return counts


def slow_thin_objects(images, edges_m):
    """Returns between two of one surface, and those that stand before it, in bins of the range behind."""
    counts = np.zeros((2, 24), dtype=int)
    for row, returned in zip(images.range_m.flatten(0, 1).tolist(), images.return_mask.flatten(0, 1), strict=True):
        for column, one_m in enumerate(row):
            sides = [(column + step) % len(row) for step in (-1, 1)]
            near_m, far_m = sorted(row[side] for side in sides)
            if returned[column] and all(returned[side] for side in sides) and far_m - near_m <= 0.1 * far_m:
                at = np.searchsorted(edges_m, near_m, side="right") - 1
                counts[:, at] += (1, one_m < 0.9 * near_m)
    return counts


@pytest.mark.parametrize(
    ("name", "slow"), [("edge_rate_per_range", slow_edges), ("thin_object_rate_per_range", slow_thin_objects)]
)
def test_edges_and_thin_objects_are_those_of_a_slow_loop(name, slow):
    images = smeared(street(0, noise_m=0.5), 0.1)
    edges_m = np.geomspace(SENSOR.range_min_m, SENSOR.range_max_m, 25)
    counted = load_metric(name)().count(images)
    assert np.abs(counted - slow(images, edges_m)).sum() <= 2  # single precision, at the limits
    assert counted[1].sum() > 50


@pytest.mark.parametrize("name", ["edge_rate_per_range", "thin_object_rate_per_range"])
def test_a_scene_that_is_smoothed_lacks_edges_and_thin_objects(name):
    """What hides from the share of flying points: it is of the edges that are left."""
    real, other = (street(seed, noise_m=0.3) for seed in (0, 1))
    smooth = RangeImage.masked(
        torch.nn.functional.avg_pool1d(other.range_m.flatten(0, 1), 5, stride=1, padding=2).reshape_as(other.range_m),
        other.return_mask & (other.range_m > 0),
        SENSOR,
    )
    assert score(name, smooth, real).value > 2 * score(name, other, real).value


def test_a_pole_before_a_wall_is_one_thin_object_and_two_edges():
    range_m = torch.full((1, SENSOR.height, SENSOR.width), 20.0)
    range_m[:, :, 40] = 10.0
    images = RangeImage.masked(range_m, torch.ones_like(range_m, dtype=torch.bool), SENSOR)
    pairs, edges = load_metric("edge_rate_per_range")().count(images).sum(axis=1)
    assert (pairs, edges) == (SENSOR.height * SENSOR.width, 2 * SENSOR.height)
    asked, thin = load_metric("thin_object_rate_per_range")().count(images).sum(axis=1)
    assert (asked, thin) == (SENSOR.height * (SENSOR.width - 2), SENSOR.height)
