"""Fréchet and kernel distances of features against reference numbers, SciPy, closed forms and slow loops."""

import itertools

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from lidargrit.evaluation.metrics.shared.networks.frechet import Moments, frechet_distance
from lidargrit.evaluation.metrics.shared.networks.kernel import kernel_distance, subset_kernel_distance


def moments(*batches):
    gathered = Moments()
    for batch in batches:
        gathered.add(batch)
    return gathered


def by_square_root(first, second):
    """The formula as programs have it, which needs more vectors than values."""
    one, two = np.cov(first, rowvar=False), np.cov(second, rowvar=False)
    apart = np.square(first.mean(0) - second.mean(0)).sum()
    return apart + np.trace(one + two - 2 * np.real(scipy.linalg.sqrtm(one @ two)))


def cloud(seed, num, size, scale=1.0, offset=0.0):
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(num, size)) @ rng.normal(size=(size, size)) * scale + offset).astype(np.float32)


def test_frechet_reference_numbers(golden):
    data = golden("frechet")
    assert frechet_distance(moments(data["X"]), moments(data["Y"])) == pytest.approx(float(data["frechet"]), rel=1e-6)


def test_frechet_reference_numbers_of_fewer_vectors_than_values(golden):
    data = golden("frechet")
    value = frechet_distance(moments(data["X"][:15]), moments(data["Y"][:12]))
    assert value == pytest.approx(float(data["frechet_rank_deficient_15_12"]), rel=1e-4)  # 1e-2 was asked for


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), size=st.integers(2, 20), scale=st.floats(0.1, 10))
def test_frechet_is_that_of_the_matrix_square_root(seed, size, scale):
    first, second = cloud(seed, 8 * size, size), cloud(seed + 1, 6 * size, size, scale, offset=1.0)
    expected = by_square_root(first.astype(np.float64), second.astype(np.float64))
    assert frechet_distance(moments(first), moments(second)) == pytest.approx(expected, rel=1e-6)


def test_frechet_of_normal_laws_whose_covariances_commute():
    # Such laws are (m1 - m2)^2 + (s1 - s2)^2 apart along every axis that they share.
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    deviations, means = rng.uniform(0, 3, (2, 6)), rng.normal(size=(2, 6))
    deviations[0, 0] = 0  # and one has no extent at all along one axis
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=6))) * np.sqrt(63 / 64)  # unbiased covariance: 1
    sets = [(corners * deviation) @ axes.T + mean for deviation, mean in zip(deviations, means, strict=True)]
    expected = np.square(means[0] - means[1]).sum() + np.square(deviations[0] - deviations[1]).sum()
    assert frechet_distance(*map(moments, sets)) == pytest.approx(expected, rel=1e-9)


def test_frechet_of_one_set_is_nothing_and_of_two_does_not_depend_on_their_order():
    first, second = moments(cloud(0, 50, 20)), moments(cloud(1, 12, 20))
    assert frechet_distance(first, first) < 1e-9
    assert frechet_distance(second, second) < 1e-9
    assert frechet_distance(first, second) == pytest.approx(frechet_distance(second, first), rel=1e-12)


def test_frechet_of_sets_without_extent():
    # One vector, again and again: only the means differ.
    assert frechet_distance(moments(np.full((3, 4), 2.0)), moments(np.full((2, 4), 5.0))) == pytest.approx(36)


@settings(max_examples=40, deadline=None)
@given(
    cuts=st.lists(st.integers(1, 30), min_size=1, max_size=8),
    merged=st.integers(0, 8),
    size=st.sampled_from([1, 3, 40]),
    offset=st.sampled_from([0.0, 1e6]),
)
def test_moments_of_parts_are_those_of_the_whole(cuts, merged, size, offset):
    batches = [np.random.default_rng(i).normal(size=(num, size)) + offset for i, num in enumerate(cuts)]
    whole = np.concatenate(batches)
    gathered = moments(*batches[:merged])
    gathered.merge(moments(*batches[merged:]))
    gathered.merge(Moments())
    assert gathered.num == len(whole)
    np.testing.assert_allclose(gathered.mean, whole.mean(0), rtol=1e-12, atol=1e-12)
    if len(whole) > 1:
        root = gathered.root()
        assert len(root) <= size
        expected = np.cov(whole, rowvar=False, ddof=1).reshape(size, size)
        np.testing.assert_allclose(root.T @ root, expected, rtol=1e-8, atol=1e-8)


def test_moments_keep_no_more_rows_than_twice_the_values():
    gathered = Moments()
    for index in range(60):
        gathered.add(cloud(index, 5, 10))
        assert sum(map(len, gathered._rows)) <= 20


def slow_kernel_distance(first, second):
    def kernel(x, y):
        return (sum(float(a) * float(b) for a, b in zip(x, y, strict=True)) / len(x) + 1) ** 3

    n, m = len(first), len(second)
    value = -2 * sum(kernel(x, y) for x in first for y in second) / (n * m)
    for side in (first, second):
        pairs = itertools.permutations(range(len(side)), 2)
        value += sum(kernel(side[i], side[j]) for i, j in pairs) / (len(side) * (len(side) - 1))
    return value


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(2, 9), m=st.integers(2, 9), size=st.integers(1, 5))
def test_kernel_distance_is_that_of_a_slow_loop(seed, n, m, size):
    first, second = cloud(seed, n, size), cloud(seed + 1, m, size, offset=0.5)
    assert kernel_distance(first, second) == pytest.approx(slow_kernel_distance(first, second), rel=1e-9, abs=1e-9)


def test_kernel_distance_of_more_rows_than_are_held_at_once():
    first, second = cloud(0, 1030, 2, 0.1), cloud(1, 2050, 2, 0.1)
    joined = np.concatenate((first, second)).astype(np.float64)
    kernel = (joined @ joined.T / 2 + 1) ** 3
    np.fill_diagonal(kernel, 0)
    expected = kernel[:1030, :1030].sum() / (1030 * 1029) + kernel[1030:, 1030:].sum() / (2050 * 2049)
    assert kernel_distance(first, second) == pytest.approx(expected - 2 * kernel[:1030, 1030:].mean(), rel=1e-9)


def test_kernel_reference_numbers_with_the_draws_of_the_reference(golden):
    data = golden("frechet")
    means = []
    for seed in range(20):
        rng = np.random.RandomState(seed)
        draws = []
        for _ in range(100):
            second = data["Y"][rng.choice(80, 40, replace=False)]
            draws.append(kernel_distance(data["X"][rng.choice(90, 40, replace=False)], second))
        means.append(np.mean(draws))
    assert np.mean(means) == pytest.approx(float(data["kpd_mean"]), rel=1e-9)


def test_kernel_reference_numbers_with_our_draws(golden):
    data = golden("frechet")
    means = [subset_kernel_distance(data["X"], data["Y"], seed, at_most=40) for seed in range(20)]
    assert abs(np.mean(means) - data["kpd_mean"]) < 3 * data["kpd_std"] / np.sqrt(20)
    assert len(set(means)) == 20
    assert means[3] == subset_kernel_distance(data["X"], data["Y"], 3, at_most=40)


def test_subsets_of_the_whole_are_the_whole():
    first, second = cloud(0, 30, 4), cloud(1, 30, 4)
    assert subset_kernel_distance(first, second, 0) == kernel_distance(first, second)


def test_kernel_distance_is_unbiased():
    values = [kernel_distance(*np.random.default_rng(seed).normal(size=(2, 12, 3))) for seed in range(2000)]
    assert abs(np.mean(values)) < 4 * np.std(values) / np.sqrt(2000)
    assert min(values) < 0
