"""The curves of realism and their distances, against slow loops and SciPy."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.distance import jensenshannon

from lidargrit.core.errors import ConfigError, DataError
from lidargrit.evaluation.metrics import load_metric
from lidargrit.evaluation.metrics.shared.curves import LocalSurface, compare_shares, divergence
from lidargrit.scans.sensors import SensorModel, load_sensor
from lidargrit.scans.types import RangeImage

SENSOR = SensorModel(
    name="small",
    elevation_rad=torch.linspace(math.radians(4), math.radians(-20), 24)[:, None],
    azimuth_rad=(math.pi - 2 * math.pi * (torch.arange(32) + 0.5) / 32)[None],
    range_min_m=1.0,
    range_max_m=100.0,
    projection="spherical",
)


def noise(seed, count=6, drop_share=0.3):
    rng = torch.Generator().manual_seed(seed)
    shape = (count, SENSOR.height, SENSOR.width)
    range_m = 1 + 98 * torch.rand(shape, generator=rng) ** 2
    smooth = torch.rand(shape, generator=rng).cumsum(dim=2).sin() / 2 + 0.5  # drops come in runs
    mask = smooth > drop_share
    mask[0, 3] = False  # a row without any return
    mask[1, :3] = True
    hundredths = torch.randint(101, shape, generator=rng) / 100
    return RangeImage(torch.where(mask, range_m, 0), mask, SENSOR, {"reflectance": torch.where(mask, hundredths, 0)})


GENERATED, REAL = noise(0), noise(1, count=5, drop_share=0.5)


def score(name, generated=GENERATED, real=REAL):
    metric = load_metric(name)()
    metric.update(generated, real=False)
    metric.update(real, real=True)
    return metric.compute()


def coins(first, second):
    """Root of the mean over pairs of coins of their squared distance, by SciPy."""
    pairs = [jensenshannon([p, 1 - p], [q, 1 - q], base=2) ** 2 for p, q in zip(first, second, strict=True)]
    return math.sqrt(np.mean(pairs))


def curves(result):
    return result.details["generated"], result.details["real"]


def test_divergence_is_the_square_of_scipys_distance():
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, 50, (7, 9)), rng.integers(0, 50, (7, 9))
    assert np.allclose(divergence(first, second), jensenshannon(first, second, base=2, axis=1) ** 2)
    assert divergence(first, first).tolist() == [0] * 7
    apart = divergence(np.array([[3, 0], [0, 0], [0, 0], [1, 1]]), np.array([[0, 9], [0, 0], [1, 2], [0, 0]]))
    assert apart.tolist() == [1, 0, 1, 1]


def test_bins_seen_too_rarely_do_not_count():
    axis = np.arange(3.0)
    generated, real = np.array([[900, 900, 4], [450, 90, 4]]), np.array([[800, 499, 0], [200, 499, 0]])
    kept = compare_shares(generated, real, axis)
    assert math.isclose(kept.divergence, coins([0.5], [0.25]) ** 2)
    assert np.isnan(kept.real).tolist() == [False, True, True]
    few = compare_shares(generated // 10, real // 10, axis)  # where all are rare, what there is
    assert math.isclose(few.divergence, coins([0.5, 0.1], [0.25, 1.0]) ** 2)
    nothing = np.zeros((2, 3), dtype=int)
    assert compare_shares(generated, nothing, axis).divergence == 1
    assert compare_shares(nothing, nothing, axis).divergence == 0


def test_return_rate_per_ring():
    shares = [[side.return_mask[:, row].float().mean().item() for row in range(24)] for side in (GENERATED, REAL)]
    result = score("return_rate_per_ring")
    assert math.isclose(result.value, coins(*shares), rel_tol=1e-6)
    assert np.allclose(curves(result), shares)


def test_range_histogram_per_ring():
    edges = [1.0 * 100 ** (k / 32) for k in range(33)]
    distances = []
    for row in range(24):
        histograms = np.zeros((2, 32))
        for which, side in enumerate((GENERATED, REAL)):
            for image in range(len(side)):
                for column in range(32):
                    if side.return_mask[image, row, column]:
                        range_m = side.range_m[image, row, column].item()
                        histograms[which, max(k for k in range(32) if edges[k] <= range_m)] += 1
        distances.append(jensenshannon(*histograms, base=2) ** 2)
    assert math.isclose(score("range_histogram_per_ring").value, math.sqrt(np.mean(distances)), rel_tol=1e-6)


def test_ranges_at_the_limits_are_counted():
    range_m = torch.full((1, 24, 32), 100.0)
    range_m[0, :, ::2] = 1.0
    image = RangeImage(range_m, range_m > 0, SENSOR)
    ends = np.array(curves(score("range_histogram_per_ring", image, image))[0])
    assert (ends[:, [0, -1]] == 0.5).all()


def slow_runs(side):
    """Walk round every row and count."""
    lengths = []
    for rows in side.return_mask.tolist():
        for row in rows:
            if not any(row):
                lengths.append(len(row))
                continue
            start = row.index(True)
            run = 0
            for step in range(1, len(row) + 1):
                if row[(start + step) % len(row)]:
                    lengths += [run] * (run > 0)
                    run = 0
                else:
                    run += 1
    return lengths


def test_drop_run_lengths():
    bins = [(1, 1), (2, 2), (3, 3), (4, 5), (6, 7), (8, 10), (11, 15), (16, 22), (23, 32)]
    histograms = [[sum(a <= run <= b for run in slow_runs(side)) for a, b in bins] for side in (GENERATED, REAL)]
    result = score("drop_run_lengths")
    assert math.isclose(result.value, jensenshannon(*histograms, base=2), rel_tol=1e-6)
    assert np.allclose(curves(result), [np.divide(h, sum(h)) for h in histograms])


def test_a_run_over_the_seam_is_one():
    mask = torch.ones(1, 24, 32, dtype=torch.bool)
    mask[0, 5, [0, 1, 30, 31]] = False
    result = score("drop_run_lengths", RangeImage.masked(torch.full(mask.shape, 5.0), mask, SENSOR))
    assert curves(result)[0] == [0, 0, 0, 1, 0, 0, 0, 0, 0]


def test_without_a_drop_there_are_no_runs():
    whole = RangeImage(torch.full((2, 24, 32), 5.0), torch.ones(2, 24, 32, dtype=torch.bool), SENSOR)
    for name in ("drop_run_lengths", "drop_correlation"):
        assert score(name, whole, whole).value == 0
        assert score(name, whole, REAL).value == 1
        assert curves(score(name, whole, REAL))[0] == [None] * len(score(name).details["axis"])


def test_drop_correlation():
    shares = []
    for side in (GENERATED, REAL):
        dropped, each = ~side.return_mask.numpy(), []
        for rows, columns in [(2, 0), (1, 0), (0, 1), (0, 2), (0, 4), (0, 8), (0, 16)]:
            pairs = [
                dropped[image, row + rows, (column + columns) % 32]
                for image, row, column in np.argwhere(dropped)
                if row + rows < 24
            ]
            each.append(np.mean(pairs))
        shares.append(each)
    result = score("drop_correlation")
    assert math.isclose(result.value, coins(*shares), rel_tol=1e-6)
    assert np.allclose(curves(result), shares)


def test_reflectance_histogram():
    histograms = []
    for side in (GENERATED, REAL):
        hundredths = (side.reflectance[side.return_mask].double() * 100).round().long()
        histograms.append([int((hundredths // 2 == k).sum()) for k in range(51)])
    assert math.isclose(score("reflectance_histogram").value, jensenshannon(*histograms, base=2), rel_tol=1e-6)


def test_images_without_reflectance_are_refused():
    bare = RangeImage(REAL.range_m, REAL.return_mask, SENSOR)
    with pytest.raises(DataError, match="got range images without reflectance for 'reflectance_histogram'; wanted"):
        score("reflectance_histogram", GENERATED, bare)


def test_bev_occupancy():
    seen = np.zeros((2, 100, 100))
    for which, side in enumerate((GENERATED, REAL)):
        for image in range(len(side)):
            cells = set()
            for row, column in np.argwhere(side.return_mask[image].numpy()):
                range_m = side.range_m[image, row, column].item()
                elevation, azimuth = SENSOR.elevation_rad[row, 0].item(), SENSOR.azimuth_rad[0, column].item()
                flat = range_m * math.cos(elevation)
                cell = math.floor(flat * math.cos(azimuth)) + 50, math.floor(flat * math.sin(azimuth)) + 50
                if min(cell) >= 0 and max(cell) < 100:
                    cells.add(cell)
            for cell in cells:
                seen[which][cell] += 1
        seen[which] /= len(side)
    result = score("bev_occupancy")
    ever = seen.any(axis=0)
    assert math.isclose(result.value, coins(seen[0][ever], seen[1][ever]), rel_tol=1e-6)
    assert np.allclose(curves(result), seen)


def slow_surroundings(image, row, column):
    """Walk outwards from one pixel of one image (step 1, at most 8); return range and incidence, None if unknown."""
    elevations = SENSOR.elevation_rad[:, 0].tolist()

    def first(row_step, column_step):
        for k in range(1, 9):
            at = row + k * row_step, (column + k * column_step) % 32
            if 0 <= at[0] < 24 and image.return_mask[at]:
                away = elevations[at[0]] - elevations[row] if row_step else k * 2 * math.pi / 32
                return 1 / image.range_m[at].item(), abs(away)
        return None

    sides = [first(*step) for step in ((0, -1), (0, 1), (-1, 0), (1, 0))]
    if sides[0] is None or sides[1] is None:
        return None, None
    means, slopes = [], []
    for one, other in (sides[:2], sides[2:]):
        if one is None or other is None:
            break
        slopes.append((one[0] - other[0]) / (one[1] + other[1]))
        means.append((one[0] * other[1] + other[0] * one[1]) / (one[1] + other[1]))
    if abs(sides[0][0] - sides[1][0]) > 0.1 * max(sides[0][0], sides[1][0]):
        return None, None
    if len(means) < 2 or abs(means[0] - means[1]) > 0.1 * means[0]:
        return 1 / means[0], None
    along = math.hypot(slopes[0] / math.cos(elevations[row]), slopes[1])
    return 1 / means[0], math.degrees(math.atan2(along, means[0]))


def rough_plane(seed, drop_share):
    """Ground with noise, so that some neighbours agree and others do not."""
    rng = torch.Generator().manual_seed(seed)
    range_m = (2 / torch.sin(-SENSOR.elevation_rad.clamp(max=-0.03))).expand(3, 24, 32)
    range_m = range_m * (1 + 0.05 * torch.randn(3, 24, 32, generator=rng))
    return RangeImage.masked(range_m, torch.rand(range_m.shape, generator=rng) > drop_share, SENSOR)


@pytest.mark.parametrize("name", ["return_rate_per_range", "return_rate_by_incidence"])
def test_return_rates_against_the_neighbours(name):
    sides = rough_plane(0, 0.2), rough_plane(1, 0.4)
    edges = np.geomspace(1, 100, 25) if name == "return_rate_per_range" else np.linspace(0, 90, 19)
    counts = np.zeros((2, 2, len(edges) - 1), dtype=int)
    for which, side in enumerate(sides):
        for image, row, column in np.ndindex(3, 24, 32):
            quantity = slow_surroundings(side[image], row, column)[name == "return_rate_by_incidence"]
            if quantity is not None:
                counts[which, int(side.return_mask[image, row, column]), np.searchsorted(edges, quantity) - 1] += 1
    tried, happened = counts.sum(axis=1), counts[:, 1]
    ever = tried.min(axis=0) > 0  # none is seen 500 times in sets as small as these
    assert 0 < tried.max() < 500
    shares = happened[:, ever] / tried[:, ever]
    result = score(name, *sides)
    assert math.isclose(result.value, coins(*shares), rel_tol=1e-5)
    assert np.allclose([[v for v in curve if v is not None] for curve in curves(result)], shares)


@pytest.mark.parametrize("columns", [256, 2048])
def test_surroundings_of_planes_are_exact(columns):
    """A wall 10 m to the left and the ground below, both strewn with holes: range and incidence by trigonometry."""
    sensor = load_sensor("hdl64e_kitti_odometry").with_columns(columns)
    directions = sensor.ray_directions()
    to_ground, to_wall = 1.73 / (-directions[..., 2]).clamp(min=1e-3), 10 / directions[..., 1].clamp(min=1e-3)
    on_ground = to_ground < to_wall
    range_m = torch.minimum(to_ground, to_wall)
    mask = (torch.rand(range_m.shape, generator=torch.Generator().manual_seed(0)) > 0.3) & (range_m < 80)
    around = LocalSurface.of(RangeImage.stack([RangeImage.masked(range_m, mask, sensor)]))
    cosine = torch.where(on_ground, -directions[..., 2], directions[..., 1])
    known = ~around.incidence_rad[0].isnan()
    assert known.float().mean() > 0.5
    assert known[~mask].float().mean() > 0.5 * known[mask].float().mean()
    wrong_m = ((around.range_m[0] - range_m) / range_m)[known].abs()
    wrong_deg = (around.incidence_rad[0].rad2deg() - cosine.acos().rad2deg())[known].abs()
    assert float(wrong_m.quantile(0.95)) < 0.01
    assert float(wrong_deg.quantile(0.95)) < 1.0


def test_a_coin_is_seen_as_one_rate_at_every_range():
    """A pixel's own return does not choose where it is counted: the rate found is the rate of the coin."""
    sensor = load_sensor("hdl64e_kitti_odometry")
    range_m = (1.73 / torch.sin(-sensor.elevation_rad).clamp(min=0.03)).expand(8, 64, 256)
    mask = torch.rand(range_m.shape, generator=torch.Generator().manual_seed(3)) < 0.7
    image = RangeImage.masked(range_m, mask, sensor)
    rates = [rate for rate in curves(score("return_rate_per_range", image, image))[0] if rate is not None]
    assert len(rates) >= 10
    assert np.allclose(rates, 0.7, atol=0.03)


def test_images_of_two_kinds_are_refused():
    metric = load_metric("bev_occupancy")()
    metric.update(REAL, real=True)
    wide = load_sensor("hdl64e_kitti_odometry")
    with pytest.raises(ConfigError, match=r"got range images of 64x256 between 0\.9 and 120 m; wanted 24x32"):
        metric.update(RangeImage(torch.ones(64, 256), torch.ones(64, 256, dtype=torch.bool), wide), real=False)


def test_returns_at_the_limits_are_asked():
    """0.9 as float32 is a little below 0.9, and generators clamp to it."""
    sensor = load_sensor("hdl64e_kitti_odometry")
    for limit in (sensor.range_min_m, sensor.range_max_m):
        everywhere = torch.ones(1, 64, sensor.width)
        images = RangeImage.masked(limit * everywhere, everywhere > 0, sensor)
        assert load_metric("edge_rate_per_range")().count(images)[0].sum() > 0
