"""Metrics of point clouds against the program's numbers, slow loops, scipy and their definitions."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import cdist, jensenshannon

from lidargrit.evaluation.metrics import load_metric, update_together
from lidargrit.evaluation.metrics import point_cloud_jsd as jsd
from lidargrit.evaluation.metrics.shared import clouds as _clouds
from lidargrit.evaluation.metrics.shared import farthest_points as _farthest_points
from lidargrit.evaluation.metrics.shared import matching
from lidargrit.evaluation.metrics.shared.clouds import bits_reversed, sampled_clouds
from lidargrit.evaluation.metrics.shared.farthest_points import farthest_points
from lidargrit.scans.sensors import SensorModel, column_azimuths_rad
from lidargrit.scans.types import RangeImage

SENSOR = SensorModel("small", torch.linspace(0.05, -0.4, 16)[:, None], column_azimuths_rad(64), 1.0, 80.0, "spherical")
MATCHING = ["minimum_matching_distance", "coverage", "one_nearest_neighbour"]
VARIANTS = ["exact", "reference"]


def random_images(seed, count, far_m=70.0):
    rng = torch.Generator().manual_seed(seed)
    range_m = 1.0 + far_m * torch.rand(count, 16, 64, generator=rng) ** 2
    return RangeImage.masked(range_m, torch.rand(range_m.shape, generator=rng) > 0.2, SENSOR)


def random_clouds(seed, count, points=40, scale=0.3):
    return (np.random.default_rng(seed).normal(size=(count, points, 3)) * scale).astype(np.float32)


def score(name, generated, real, **options):
    metric = load_metric(name)(**options)
    metric.update(generated, real=False)
    metric.update(real, real=True)
    return metric.compute()


# Against the program


@pytest.mark.shared
def test_farthest_points_are_the_programs(golden):
    data = golden("fps")
    points = data["points"]
    candidates = (np.square(points[..., 0]) + np.square(points[..., 1]) + np.square(points[..., 2])) > np.float32(1e-3)
    ours = farthest_points(points, candidates, 512, 0, bits_reversed(points.shape[1]))
    assert np.array_equal(ours, data["idx_512"])
    clouds = sampled_clouds(points, "reference")
    assert np.array_equal(clouds, np.take_along_axis(points, data["idx_512"][..., None].astype(np.int64), axis=1))


@pytest.mark.shared
def test_chamfer_matrices_are_the_programs(golden):
    data = golden("pointset")
    assert np.allclose(matching.chamfer_matrix(data["ref"], data["gen"]), data["M_rg"], atol=1e-6)
    for side, key in (("ref", "M_rr"), ("gen", "M_gg")):
        ours = matching.chamfer_matrix(data[side])
        assert np.isposinf(np.diag(ours)).all()
        off = ~np.eye(len(ours), dtype=bool)
        assert np.allclose(ours[off], data[key][off], atol=1e-6)
    assert matching.chamfer_distance(data["ref"][3], data["gen"][5]) == pytest.approx(data["M_rg"][3, 5], abs=1e-7)


@pytest.mark.shared
def test_matching_scores_are_the_programs(golden):
    data = golden("pointset")
    matched, details = load_metric("minimum_matching_distance")().compare(data["gen"], data["ref"])
    assert matched == pytest.approx(float(data["res_mmd-cd"]), abs=1e-8)
    assert details["generated_to_real"] == pytest.approx(float(data["res_mmd-sample-cd"]), abs=1e-8)
    assert load_metric("coverage")().compare(data["gen"], data["ref"])[0] == float(data["res_cov-cd"])
    value, details = load_metric("one_nearest_neighbour")().compare(data["gen"], data["ref"])
    assert value == pytest.approx(
        float(data["res_1-nn-accuracy-cd"]), abs=1e-7
    )  # it adds a little to what it divides by
    assert details["real"] == pytest.approx(float(data["res_1-nn-accuracy_t-cd"]), abs=1e-7)
    assert details["generated"] == pytest.approx(float(data["res_1-nn-accuracy_f-cd"]), abs=1e-7)


@pytest.mark.shared
def test_grid_and_divergence_are_the_programs(golden):
    data = golden("pointset")
    generated, real = (jsd.grid_counts(data[side].reshape(-1, 3)) for side in ("gen", "ref"))
    assert len(real) == int(data["grid_points_in_sphere"])
    assert np.array_equal(generated, data["counts_gen"])
    assert np.array_equal(real, data["counts_ref"])
    compare = load_metric("point_cloud_jsd")(variant="reference").compare
    assert compare(generated, real)[0] == pytest.approx(float(data["jsd3d"]), abs=1e-6)
    assert compare(generated, generated)[0] == pytest.approx(float(data["jsd3d_self"]), abs=1e-6)


# Farthest points


def slow_farthest_points(points, candidates, num, start, precedence):
    order = {int(index): rank for rank, index in enumerate(precedence)}
    nearest = np.where(candidates, np.float32(1e10), np.float32(-1))
    chosen, last = ([], np.zeros(3, np.float32)) if start is None else ([start], points[start])
    while len(chosen) < num:
        square = np.square(points - last)
        nearest = np.minimum(nearest, square[:, 0] + square[:, 1] + square[:, 2])
        chosen.append(min(np.flatnonzero(nearest == nearest.max()).tolist(), key=order.get))
        last = points[chosen[-1]]
    return chosen


@given(
    st.integers(0, 2**31), st.integers(1, 400), st.integers(1, 60), st.booleans(), st.booleans(), st.floats(0.0, 1.0)
)
def test_farthest_points_are_those_of_a_slow_loop(seed, n, num, lattice, from_origin, share):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(2, n, 3)).astype(np.float32)
    if lattice:  # many points equally far, and many alike
        points = np.rint(points)
    candidates = rng.random((2, n)) < share
    precedence = rng.permutation(n)
    start = None if from_origin else int(rng.integers(n))
    ours = farthest_points(points, candidates, num, start, precedence)
    for cloud in range(2):
        slow = slow_farthest_points(points[cloud], candidates[cloud], num, start, precedence)
        assert ours[cloud].tolist() == slow


def test_farthest_points_of_many_buckets(monkeypatch):
    points = np.random.default_rng(0).normal(size=(3, 5000, 3)).astype(np.float32)
    every = np.ones((3, 5000), dtype=bool)
    ours = farthest_points(points, every, 100)
    for cloud in range(3):
        assert ours[cloud].tolist() == slow_farthest_points(points[cloud], every[cloud], 100, None, range(5000))
    monkeypatch.setattr(_farthest_points, "_BUCKET", 37)
    assert np.array_equal(farthest_points(points, every, 100), ours)


def test_bits_are_reversed():
    slow = sorted(range(1500), key=lambda k: (f"{k % 512:09b}"[::-1], k))
    assert bits_reversed(1500).tolist() == slow


def test_exact_clouds_are_of_returns_only_and_reference_keeps_the_first_pixel():
    images = random_images(0, 2)
    images = RangeImage.masked(images.range_m, images.return_mask & (torch.arange(1024).view(16, 64) > 0), SENSOR)
    exact, reference = (_clouds.FarthestPointClouds(variant)(images) for variant in VARIANTS)
    assert (np.linalg.norm(exact, axis=2) > 1 / 80 - 1e-6).all()
    assert np.allclose(np.linalg.norm(exact[:, 0], axis=1), images.range_m.flatten(1).amax(1) / 80)  # the farthest
    assert (reference[:, 0] == 0).all()
    assert (np.linalg.norm(reference[:, 1:], axis=2) ** 2 > 1e-3 - 1e-7).all()


def test_scans_of_few_returns_take_all_in_turn():
    mask = torch.zeros(2, 16, 64, dtype=torch.bool)
    mask[1, 3, 10:15] = True
    images = RangeImage.masked(torch.full((2, 16, 64), 8.0), mask, SENSOR)
    empty, few = _clouds.FarthestPointClouds("exact")(images)
    assert (empty == 0).all()
    points, times = np.unique(few, axis=0, return_counts=True)
    assert len(points) == 5
    assert times.max() - times.min() <= 1


# Chamfer distance and matching


def slow_chamfer(first, second):
    square = cdist(first.astype(np.float64), second.astype(np.float64)) ** 2
    return square.min(axis=0).mean() + square.min(axis=1).mean()


@given(st.integers(0, 2**31), st.integers(1, 30), st.integers(1, 30), st.floats(0.01, 0.5))
def test_chamfer_distance_is_that_of_a_slow_loop(seed, n, m, scale):
    first, second = random_clouds(seed, 1, n, scale)[0], random_clouds(seed + 1, 1, m, scale)[0]
    ours = matching.chamfer_distance(first, second)
    assert ours == pytest.approx(slow_chamfer(first, second), rel=1e-9)
    assert ours == pytest.approx(matching.chamfer_distance(second, first), rel=1e-12)
    assert matching.chamfer_distance(first, first) == 0
    shuffled = np.random.default_rng(seed).permutation(first)
    assert matching.chamfer_distance(shuffled, first) == 0


def test_chamfer_matrix_is_right_to_a_millionth():
    first, second = random_clouds(0, 6, 100), random_clouds(1, 5, 100)
    slow = [[slow_chamfer(a, b) for b in second] for a in first]
    assert np.allclose(matching.chamfer_matrix(first, second), slow, rtol=0, atol=1e-6)
    near = np.clip(first, -0.57, 0.57)  # in the unit sphere, all but equal: what cancels is as large as it gets
    assert np.abs(matching.chamfer_matrix(near, near)[np.arange(6), np.arange(6)]).max() < 1e-6


def slow_scores(generated, real):
    across = np.array([[slow_chamfer(a, b) for b in generated] for a in real])
    both = [*real, *generated]
    all_pairs = np.array(
        [[np.inf if i == j else slow_chamfer(a, b) for j, b in enumerate(both)] for i, a in enumerate(both)]
    )
    is_real = np.arange(len(both)) < len(real)
    accuracy = (is_real[all_pairs.argmin(axis=1)] == is_real).mean()
    return across.min(axis=1).mean(), len(set(across.argmin(axis=0))) / len(real), accuracy


@pytest.mark.parametrize("seed", range(3))
def test_matching_scores_are_those_of_slow_loops(seed):
    generated, real = random_clouds(seed, 9, scale=0.28), random_clouds(100 + seed, 7)
    ours = [load_metric(name)().compare(generated, real)[0] for name in MATCHING]
    assert np.allclose(ours, slow_scores(generated, real), rtol=1e-9)


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_set_against_itself_is_copied(variant):
    images = random_images(0, 5)
    values = [score(name, images, images, variant=variant).value for name in MATCHING]
    assert values == [0, 1, 0]  # nothing missing, all covered, and every neighbour is the copy in the other set


def test_sets_of_one_kind_and_of_two():
    kind, same, other = random_clouds(0, 60), random_clouds(1, 60), random_clouds(2, 60) + np.float32(0.3)
    nearest, cover = load_metric("one_nearest_neighbour")(), load_metric("coverage")()
    value, details = nearest.compare(same, kind)
    assert abs(value - 0.5) < 0.15
    assert details["from_half"] == abs(value - 0.5)
    assert nearest.compare(other, kind)[0] > 0.9
    assert nearest.compare(kind, same)[0] == value  # neither set comes first
    assert cover.compare(same, kind)[0] > cover.compare(other, kind)[0]


def test_ties_count_half():
    clouds = np.repeat(random_clouds(0, 1), 4, axis=0)
    assert load_metric("one_nearest_neighbour")().compare(clouds, clouds.copy())[0] == 0.5


def test_metrics_that_are_fed_together_sample_points_once(monkeypatch):
    sampled = []

    def counted(points, *options):
        sampled.append(len(points))
        return farthest_points(points, *options)

    monkeypatch.setattr(_clouds, "farthest_points", counted)
    generated, real = random_images(777, 3), random_images(778, 3)
    names = [*MATCHING, "point_cloud_jsd"]
    metrics = [load_metric(name)() for name in names]
    update_together([(metric, False) for metric in metrics], generated)
    update_together([(metric, True) for metric in metrics], real)
    assert sampled == [3, 3]
    assert [metric.compute() for metric in metrics] == [score(name, generated, real) for name in names]


# The grid of the 3-D divergence


def slow_grid():
    axis = np.linspace(-1, 1, 28)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid[np.linalg.norm(grid, axis=1) <= 1]


def test_grid_counts_are_those_of_a_slow_loop():
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(3000, 3))
    radius = rng.random((3000, 1)) ** (1 / 3)
    radius[::3] = 1 - 0.02 * radius[::3]  # many at the rim, some beyond
    points = (direction / np.linalg.norm(direction, axis=1, keepdims=True) * radius * 1.01).astype(np.float32)
    slow = np.bincount(cdist(points.astype(np.float64), slow_grid()).argmin(axis=1), minlength=10_144)
    assert np.array_equal(jsd.grid_counts(points), slow)


def test_half_way_goes_to_the_lower_grid_point():
    counts = jsd.grid_counts(np.zeros((3, 3), dtype=np.float32))
    assert np.allclose(slow_grid()[counts.argmax()], -1 / 27)
    assert counts.max() == 3


@given(st.integers(0, 2**31))
def test_exact_divergence_is_scipys(seed):
    first, second = (np.random.default_rng(seed + k).poisson(0.3, 10_144) for k in (0, 1))
    compare = load_metric("point_cloud_jsd")().compare
    theirs = jensenshannon(first / first.sum(), second / second.sum(), base=2) ** 2
    assert compare(first, second)[0] == pytest.approx(float(theirs), rel=1e-9)
    assert compare(first, second)[0] == pytest.approx(compare(second, first)[0], rel=1e-12)
    assert compare(first, first)[0] == 0


def test_no_two_sets_are_beyond_the_bounds():
    nothing_in_common = np.repeat(np.eye(2, dtype=np.int64), 5072, 1)
    metric = load_metric("point_cloud_jsd")
    for first, second in (nothing_in_common, np.eye(2, 10_144, dtype=np.int64)):
        for variant in metric.variants:
            assert 0.999 < metric(variant=variant).compare(first, second)[0] <= metric.bounds[1]


def test_only_counts_are_kept():
    metric = load_metric("point_cloud_jsd")()
    for seed in range(3):
        metric.update(random_images(seed, 4), real=True)
    assert metric._kept[True].value().shape == (10_144,)
    assert metric._kept[True].value().sum() == 12 * 512
