"""Histograms and scores of bird's-eye views against the programs' numbers, scipy, slow loops and their definitions."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import jensenshannon

from lidargrit.core.errors import ConfigError
from lidargrit.evaluation.metrics import bev_mmd, load_metric, update_together
from lidargrit.evaluation.metrics import lidm_bev_matching as matching
from lidargrit.evaluation.metrics.shared import birds_eye as above
from lidargrit.scans.projection import points_of_pixels
from lidargrit.scans.sensors import SensorModel, column_azimuths_rad
from lidargrit.scans.types import RangeImage

SENSOR = SensorModel("small", torch.linspace(0.05, -0.4, 16)[:, None], column_azimuths_rad(64), 1.0, 100.0, "spherical")
GOLDEN_OF = {"exact": "lidargen", "lidargrit": "lidargrit", "r2dm": "r2dm", "lidargen": "lidargen"}


def random_images(seed, count, far_m=80.0, sensor=SENSOR):
    rng = torch.Generator().manual_seed(seed)
    range_m = 1.0 + far_m * torch.rand(count, sensor.height, sensor.width, generator=rng) ** 2
    return RangeImage.masked(range_m, torch.rand(range_m.shape, generator=rng) > 0.2, sensor)


def score(name, generated, real, **options):
    metric = load_metric(name)(**options)
    metric.update(generated, real=False)
    metric.update(real, real=True)
    return metric.compute().value


# Against the programs


@pytest.mark.shared
@pytest.mark.parametrize("variant", above.VARIANTS)
@pytest.mark.parametrize("which", [1, 2])
def test_histograms_are_the_programs(golden, variant, which):
    data = golden("bev")
    ours = above.histograms(torch.from_numpy(data[f"clouds_{which}"]), variant)
    assert np.array_equal(ours.reshape(-1, 100, 100), data[f"{GOLDEN_OF[variant]}_hist_{which}"])


@pytest.mark.shared
@pytest.mark.parametrize(("variant", "rtol"), [("lidargrit", 1e-9), ("lidargen", 1e-9), ("r2dm", 1e-6)])
def test_jsd_and_mmd_are_the_programs(golden, variant, rtol):
    data = golden("bev")
    first, second = (above.histograms(torch.from_numpy(data[f"clouds_{which}"]), variant) for which in (1, 2))
    single = "_float32" if variant == "r2dm" else ""  # R2DM computes in single precision
    jsd = above.jensen_shannon_distance(first.sum(axis=0), second.sum(axis=0))
    assert jsd == pytest.approx(float(data[f"{variant}_jsd{single}"]), rel=rtol)
    norm, key = (
        (bev_mmd.spectral, "lidargen_mmd_spectral_norm")
        if variant == "lidargen"
        else (bev_mmd.frobenius, f"{variant}_mmd{single}")
    )
    mmd = bev_mmd.discrepancy(first, second, norm, unbiased=False)
    assert mmd == pytest.approx(float(data[key]), abs=2e-7 if single else 1e-12)


@pytest.mark.shared
def test_lidargen_moves_far_returns_to_63_m(golden):
    data = golden("r2dm_lidargen_depth_xyz")
    elevation, azimuth = torch.from_numpy(data["ray_angles"])[0]
    edges = SensorModel("edges", elevation[:, :1], azimuth[:1], 0.1, 90.0, "spherical")
    range_m = torch.from_numpy(data["metric"][:1, 0])
    points = above.points_from_above(RangeImage.masked(range_m, range_m > 0, edges), "lidargen")[0]
    seen = points[points.norm(dim=1) > 3]
    assert torch.allclose(seen, torch.from_numpy(data["lidargen_points_from_1024"]), atol=2e-4)  # it adds 0.1 mm


def test_r2dm_leaves_out_returns_beyond_63_m():
    images = random_images(0, 3)
    points = above.points_from_above(images, "r2dm")
    kept = (images.range_m < 63) & images.return_mask
    assert torch.equal(points.norm(dim=2) > 0, kept.flatten(1))
    assert torch.equal(points, points_of_pixels(images).flatten(1, 2) * kept.flatten(1)[..., None])


# Against slow loops and scipy


@pytest.mark.parametrize("variant", above.VARIANTS)
def test_histograms_are_those_of_a_slow_loop(variant):
    points = points_of_pixels(random_images(1, 2)).flatten(1, 2)
    slow = np.zeros((2, 100, 100), dtype=int)
    for scan, cloud in enumerate(points.tolist()):
        for x, y, z in cloud:
            if 3 < math.sqrt(x * x + y * y + z * z) < 70:
                slow[scan, math.floor((x + 80) / 1.6), math.floor((y + 80) / 1.6)] += 1
    assert np.array_equal(above.histograms(points, variant).reshape(2, 100, 100), slow)


@given(st.integers(-40, 39), st.integers(0, 7))
def test_exact_cells_hold_their_lower_border(cell, eighth):
    x_m = np.float32(cell * 1.6) if cell % 5 else np.float32(8 * (cell // 5) + eighth)  # multiples of 8 m are exact
    cells = np.array([math.floor(float(x_m) * 5 / 8) + 50])
    assert np.array_equal(above._exact(np.array([x_m])), cells)


@given(st.integers(0, 2**31), st.integers(2, 7), st.integers(2, 7), st.booleans())
def test_mmd_is_that_of_a_slow_loop(seed, n, m, unbiased):
    rng = np.random.default_rng(seed)
    first, second = (rng.integers(0, 9, (count, 10_000)).astype(np.uint16) for count in (n, m))

    def kernel(one, other):
        p, q = one / one.sum(), other / other.sum()
        return math.exp(-((p - q) ** 2).sum() / 0.5)

    def mean(one, other, skip):
        pairs = [kernel(a, b) for i, a in enumerate(one) for j, b in enumerate(other) if not (skip and i == j)]
        return sum(pairs) / len(pairs)

    slow = mean(first, first, unbiased) + mean(second, second, unbiased) - 2 * mean(first, second, False)
    assert bev_mmd.discrepancy(first, second, bev_mmd.frobenius, unbiased=unbiased) == pytest.approx(slow, abs=1e-12)


def test_blocks_change_nothing(monkeypatch):
    counts = np.random.default_rng(0).integers(0, 9, (11, 10_000))
    whole = bev_mmd.discrepancy(counts[:6], counts[6:], bev_mmd.frobenius, unbiased=True)
    spectral = bev_mmd.spectral(bev_mmd.shares(counts[:2]), bev_mmd.shares(counts[2:5]))
    norms = [
        np.linalg.norm((p - q).reshape(100, 100), 2)
        for p in bev_mmd.shares(counts[:2])
        for q in bev_mmd.shares(counts[2:5])
    ]
    assert np.allclose(spectral.ravel(), np.square(norms), rtol=1e-9)
    monkeypatch.setattr(bev_mmd, "_BLOCK", 4)
    monkeypatch.setattr(bev_mmd, "_PAIRS", 2)
    assert bev_mmd.discrepancy(counts[:6], counts[6:], bev_mmd.frobenius, unbiased=True) == pytest.approx(
        whole, abs=1e-15
    )
    assert np.array_equal(bev_mmd.spectral(bev_mmd.shares(counts[:2]), bev_mmd.shares(counts[2:5])), spectral)


def test_jsd_is_scipys_on_the_sums():
    generated, real = random_images(0, 5), random_images(1, 4, far_m=60.0)
    sums = [
        above.histograms(points_of_pixels(images).flatten(1, 2), "exact").sum(axis=0) for images in (generated, real)
    ]
    assert score("bev_jsd", generated, real) == pytest.approx(
        float(jensenshannon(*(s / s.sum() for s in sums))), rel=1e-9
    )


def slow_cells(image, width_m):
    points = points_of_pixels(image)[image.return_mask].double()
    return {
        (math.floor(x / width_m + 1e-12), math.floor(y / width_m + 1e-12))
        for x, y, _ in points.tolist()
        if abs(x) < 50 and abs(y) < 50
    }


def test_lidm_jsd_is_that_of_a_slow_loop():
    generated, real = random_images(0, 4), random_images(1, 3)
    counts = []
    for images in (generated, real):
        counts.append({})
        for index in range(len(images)):
            for cell in slow_cells(images[index], 0.05):
                counts[-1][cell] = counts[-1].get(cell, 0) + 1
    cells = sorted(counts[0].keys() | counts[1].keys())
    p, q = (np.array([count.get(cell, 0) for cell in cells], dtype=float) for count in counts)
    assert score("lidm_bev_jsd", generated, real) == pytest.approx(
        float(jensenshannon(p / p.sum(), q / q.sum())), rel=1e-9
    )


@pytest.mark.parametrize(("variant", "width_m"), [("exact", 0.5), ("r3dpa", 0.05)])
def test_matching_is_that_of_a_slow_loop(variant, width_m):
    generated, real = random_images(0, 3), random_images(1, 2)
    cells = [
        [np.array(sorted(slow_cells(images[index], width_m))) * width_m / 100 for index in range(len(images))]
        for images in (generated, real)
    ]
    slow = []
    for one in cells[1]:
        apart = [((one[:, None] - other) ** 2).sum(axis=2) for other in cells[0]]
        slow.append(min((square.min(axis=0).mean() + square.min(axis=1).mean()) / 2 for square in apart))
    assert score("lidm_bev_matching", generated, real, variant=variant) == pytest.approx(np.mean(slow), rel=1e-12)


def test_halves_take_the_ways_of_the_whole_sets(monkeypatch):
    generated, real = random_images(3, 7), random_images(4, 6)
    whole = matching.LidmBevMatching()
    update_together([(whole, False)], generated)
    update_together([(whole, True)], real)
    monkeypatch.setattr(matching, "_BLOCK", 3)
    once = whole.compute().value
    for some, others in ((generated[:4], real[2:]), (real[:3], real[3:])):  # the second is real against real
        expected = score("lidm_bev_matching", some, others)
        half = matching.LidmBevMatching()
        half.choose_as(whole)
        update_together([(half, False)], some)
        update_together([(half, True)], others)
        with monkeypatch.context() as without:
            without.setattr(matching, "ways_between", None)
            assert half.compute().value == expected != once


@given(st.sets(st.integers(0, 4_000_000 - 1), min_size=1), st.sets(st.integers(0, 300_000), min_size=1))
def test_cells_are_packed_and_found_again(first, second):
    cells = [np.array(sorted(scan)) for scan in (first, second)]
    found, begins = matching.unpacked(np.concatenate([matching.packed(each) for each in cells]))
    assert [each.tolist() for each in np.split(found, begins[1:])] == [each.tolist() for each in cells]


# The definitions

NAMES = [("bev_jsd", v) for v in above.VARIANTS] + [("bev_mmd", v) for v in above.VARIANTS]
ROOMS = [*NAMES, ("lidm_bev_jsd", "exact"), ("lidm_bev_matching", "exact")]


@pytest.mark.parametrize(("name", "variant"), ROOMS)
def test_a_set_against_itself(name, variant):
    images = random_images(0, 4)
    value = score(name, images, images, variant=variant)
    if (name, variant) == ("bev_mmd", "exact"):
        assert value < 0  # unbiased: below the biased 0
    else:
        assert value == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(("name", "variant"), [*NAMES, ("lidm_bev_jsd", "exact")])
def test_neither_set_comes_first(name, variant):
    first, second = random_images(0, 4), random_images(1, 3, far_m=50.0)
    forth, back = (score(name, *pair, variant=variant) for pair in ((first, second), (second, first)))
    assert forth == pytest.approx(back, rel=1e-9)


@pytest.mark.parametrize(("name", "variant"), ROOMS)
def test_scans_without_a_point_in_the_window_have_a_number(name, variant):
    empty = RangeImage.masked(torch.zeros(3, 16, 64), torch.zeros(3, 16, 64, dtype=torch.bool), SENSOR)
    assert np.isfinite(score(name, empty, random_images(0, 3), variant=variant))
    assert score(name, empty, empty, variant=variant) == 0


def test_unbiased_estimates_of_one_kind_lie_around_0():
    values = [score("bev_mmd", random_images(2 * k, 6), random_images(2 * k + 1, 6)) for k in range(30)]
    biased = [
        score("bev_mmd", random_images(2 * k, 6), random_images(2 * k + 1, 6), variant="lidargrit") for k in range(30)
    ]
    assert abs(np.mean(values)) < 3 * np.std(values) / math.sqrt(30)
    assert min(values) < 0 < np.mean(biased) - 10 * abs(np.mean(values))


def test_jsd_keeps_its_size_and_mmd_what_holds_a_count():
    jsd, mmd = load_metric("bev_jsd")(), load_metric("bev_mmd")()
    for seed in range(4):
        jsd.update(random_images(seed, 10), real=True)
        mmd.update(random_images(seed, 10), real=True)
    assert jsd._kept[True].value().nbytes == 10_000 * 8
    assert mmd._kept[True].value().nbytes == 40 * 10_000  # a byte a cell while no count is above 255
    wall = RangeImage.masked(torch.full((1, 16, 64), 5.0), torch.ones(1, 16, 64, dtype=torch.bool), SENSOR)
    assert mmd.summarise(mmd.extractor(SENSOR)(wall), real=True).sum() == 16 * 64


def test_sensors_are_not_mixed():
    metric = load_metric("bev_jsd")()
    metric.update(random_images(0, 2), real=True)
    with pytest.raises(ConfigError, match="16x32 between 1 and 100 m; wanted 16x64 between 1 and 100 m"):
        metric.update(random_images(0, 2, sensor=SENSOR.with_columns(32)), real=False)
