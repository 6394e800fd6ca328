"""Intervals and real against real: against laws that are known, and what every metric has to bear for them."""

import math

import numpy as np
import pytest
import torch

from lidargrit.core import discovery
from lidargrit.core.errors import ConfigError
from lidargrit.evaluation.intervals import Part, Resampling, around, blocks, interval_of, merged, real_against_real
from lidargrit.evaluation.metrics import ImageMetric, MetricResult, load_metric
from lidargrit.evaluation.metrics.shared.accumulators import RowAccumulator
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(64)
PLAIN = [name for name in discovery.names("metrics") if not load_metric(name).needs_weights]


class Ratio(ImageMetric):
    """Ratio of the means of two samples of numbers: cheap, not linear, and of a known law.

    It is fed with lists and merged by hand, since half a million merges of range images would take minutes.
    """

    title, accumulator = "a ratio", RowAccumulator

    def __init__(self):
        super().__init__()
        self.seen = {False: [], True: []}

    def summarise(self, features, *, real):
        raise NotImplementedError

    def compare(self, generated, real):
        return float(np.mean(generated) / np.mean(real)), {}

    def compute(self):
        generated, real = self.seen[False], self.seen[True]
        value, details = self.compare(generated, real)
        return MetricResult("ratio", value, False, len(generated), len(real), "exact", details)

    def merge(self, other):
        for real, numbers in other.seen.items():
            self.seen[real] += numbers


def parts(numbers, groups, real):
    made = []
    for group in groups:
        metric = Ratio()
        metric.seen[real] += list(numbers[group.start : group.stop])
        made.append(Part(metric))
    return made


def interval(generated, real, resampling):
    groups = blocks(len(generated), resampling.groups)
    sides = parts(generated, groups, False), parts(real, groups, True)
    whole = merged(*sides)
    return interval_of(whole.compute().value, whole, *sides, resampling)


def test_the_interval_covers_the_true_value_about_as_often_as_it_says():
    rng = np.random.default_rng(0)
    hits = []
    for draw in range(200):
        found = interval(rng.gamma(4, 1, 160), rng.gamma(2, 1, 160), Resampling(16, 20, draw))
        hits.append(found.low <= 2.0 <= found.high)  # the means of the two laws are 4 and 2
    assert 0.90 <= np.mean(hits) <= 0.99


def test_neighbours_that_are_alike_make_the_interval_wider_as_they_should():
    rng = np.random.default_rng(0)
    hits = {"blocks": [], "singles": []}
    for draw in range(200):
        drives = [np.repeat(rng.gamma(shape, 1, 16), 10) for shape in (4, 2)]  # ten times the same scan in a row
        mixed = [rng.permutation(side) for side in drives]
        for name, sides in (("blocks", drives), ("singles", mixed)):
            found = interval(*sides, Resampling(16, 20, draw))
            hits[name].append(found.low <= 2.0 <= found.high)
    assert np.mean(hits["blocks"]) >= 0.85
    assert np.mean(hits["singles"]) < 0.6


def test_the_standard_error_is_that_of_many_draws():
    rng = np.random.default_rng(1)
    values, errors = [], []
    for draw in range(300):
        generated, real = rng.gamma(4, 1, 160), rng.gamma(2, 1, 160)
        values.append(np.mean(generated) / np.mean(real))
        errors.append(interval(generated, real, Resampling(16, 20, draw)).standard_error)
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.std(values), rel=0.1)


def test_half_samples_of_a_mean_have_the_standard_error_of_the_mean_exactly():
    """All halves of 6 groups: the factor is 1, with the variance of the groups' means divided by their number."""
    from itertools import combinations

    numbers = np.random.default_rng(2).normal(size=6)
    halves = [np.mean(half) for half in combinations(numbers, 3)]
    assert np.mean(np.square(np.array(halves) - numbers.mean())) == pytest.approx(np.var(numbers, ddof=1) / 6)


def test_groups_are_neighbours_and_their_number_is_even():
    assert [list(block) for block in blocks(5, 16)] == [[0], [1], [2], [3, 4]]
    assert blocks(3, 1) == [range(3)]
    for count in (4, 7, 100, 5000):
        found = blocks(count, 16)
        assert [index for block in found for index in block] == list(range(count))
        assert len(found) == min(16, count - count % 2)
        assert max(map(len, found)) - min(map(len, found)) <= 1


def test_an_interval_ends_where_the_metric_does():
    assert around(0.9, [0.7, 0.9, 1.0, 1.0], 16, load_metric("coverage").bounds).high == 1.0
    assert around(0.9, [0.7, 0.9, 1.0, 1.0], 16, load_metric("drop_correlation").bounds).high == 1.0
    assert around(0.9, [0.7, 0.9, 1.0, 1.0], 16, load_metric("sliced_wasserstein").bounds).high > 1.0
    assert around(0.01, [0.0, 0.1, 0.2], 16, load_metric("bev_jsd").bounds).low == 0.0
    unbiased = load_metric("kernel_pointcloud_distance").bounds
    assert around(0.0, [-0.1, 0.1, 0.0], 16, unbiased).low < 0
    assert around(0.01, [0.0, 0.1, 0.2], 16, unbiased).low == 0.0  # nothing says that it is below


def test_real_against_real_is_the_mean_of_halves_against_halves():
    rng = np.random.default_rng(3)
    numbers = rng.gamma(4, 1, 400)
    groups = blocks(400, 16)
    found = real_against_real(
        Ratio(), parts(numbers, groups, True), parts(numbers, groups, False), [25] * 16, Resampling()
    )
    assert found.num_scans == 200
    assert found.halvings == 5
    assert found.value == pytest.approx(1.0, abs=0.1)


def test_too_few_scans_have_neither():
    groups = blocks(3, 16)
    numbers = np.ones(3)
    sides = parts(numbers, groups, False), parts(numbers, groups, True)
    whole = merged(*sides)
    assert interval_of(whole.compute().value, whole, *sides, Resampling()) is None
    assert real_against_real(whole, sides[1], sides[0], [1, 1], Resampling()) is None


@pytest.mark.parametrize(("groups", "halves"), [(2, 20), (16, 1), (0, 5)])
def test_senseless_numbers_are_refused(groups, halves):
    with pytest.raises(ConfigError, match=rf"--intervals {halves} with --groups {groups}; .*--intervals 0 for none"):
        Resampling(groups, halves)
    assert Resampling(groups, 0).halves == 0


def images(seed, count):
    rng = torch.Generator().manual_seed(seed)
    smooth = torch.rand(count, 64, 8, generator=rng).repeat_interleave(8, dim=2)
    range_m = 2 + 40 * smooth + torch.rand(count, 64, 64, generator=rng)
    mask = torch.rand(count, 64, 64, generator=rng) < 0.8
    return RangeImage(torch.where(mask, range_m, 0), mask, SENSOR, {"reflectance": torch.where(mask, smooth, 0)})


@pytest.mark.parametrize("name", PLAIN)
@pytest.mark.parametrize("packed", [False, True])
def test_every_metric_can_be_merged_from_parts_of_one_side_only(name, packed, monkeypatch):
    if packed:
        monkeypatch.setattr("lidargrit.evaluation.intervals._LARGE_BYTES", 0)
    whole, pieces = load_metric(name)(), {False: [], True: []}
    for real in (False, True):
        batch = images(int(real), 8)
        whole.update(batch, real=real)
        for start in (0, 3):
            part = load_metric(name)()
            part.update(batch[start : (3, 8)[start > 0]], real=real)
            pieces[real].append(Part(part))
    result = merged(pieces[False], pieces[True]).compute()
    assert math.isclose(result.value, whole.compute().value, rel_tol=1e-4, abs_tol=1e-7)
    assert (result.num_generated, result.num_reference) == (8, 8)


@pytest.mark.parametrize("name", ["flying_points", "edge_rate_per_range", "thin_object_rate_per_range"])
def test_halves_compare_the_bins_of_the_whole_sets(name, monkeypatch):
    """Half as many pixels leave fewer bins with 500, and none where all are rare, so that all of them count."""
    monkeypatch.setattr("lidargrit.evaluation.metrics.shared.curves._LEAST", 300)
    whole, half = load_metric(name)(), load_metric(name)()
    for real in (False, True):
        whole.update(images(int(real), 8), real=real)
        half.update(images(int(real), 8)[:4], real=real)
    alone = half.compute().details["real"]
    half.choose_as(whole)
    chosen = [share is not None for share in whole.compute().details["real"]]
    assert [share is not None for share in half.compute().details["real"]] == chosen
    assert [share is not None for share in alone] != chosen
    monkeypatch.undo()
    assert whole.kept(real=True).shape == half.kept(real=True).shape


def test_intervals_and_real_against_real_are_of_the_score_s_bins(monkeypatch):
    seen = []
    monkeypatch.setattr(
        "lidargrit.evaluation.metrics.shared.curves.enough_trials",
        lambda generated, real: seen.append(1) or (generated[0] >= 0),
    )
    sides = {real: [] for real in (False, True)}
    for real, start in ((real, start) for real in sides for start in range(0, 8, 2)):
        part = load_metric("flying_points")()
        part.update(images(int(real), 8)[start : start + 2], real=real)
        sides[real].append(Part(part))
    whole = merged(sides[False], sides[True])
    interval_of(whole.compute().value, whole, sides[False], sides[True], Resampling(4, 20))
    assert len(seen) == 1 + 20
