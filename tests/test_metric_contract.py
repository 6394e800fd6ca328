"""What every metric promises, asked of every file in ``evaluation/metrics/`` and each of its variants."""

import contextlib
import functools
import pickle
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidargrit.core import discovery
from lidargrit.core.errors import ConfigError, DataError, UnknownNameError
from lidargrit.evaluation.metrics import Metric, MetricResult, lidm_bev_matching, load_metric
from lidargrit.evaluation.metrics.shared import clouds
from lidargrit.evaluation.metrics.shared.accumulators import SumAccumulator
from lidargrit.evaluation.metrics.shared.labelled import LabelMetric
from lidargrit.evaluation.metrics.shared.networks.network import PretrainedNetwork
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from seeded_networks import weights_folder

CASES = [(name, variant) for name in discovery.names("metrics") for variant in load_metric(name).variants]
SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(128)
SMALL = replace(SENSOR, elevation_rad=SENSOR.elevation_rad[::8]).with_columns(32)

# Noise of 3 m is too little for cells of 1.6 m and accuracies in steps of 1 in 32; but surfaces are gone long before.
NOISE_M = {"flying_points": (0.3, 1.0), "object_statistics": (0.6, 1.5), "wall_straightness": (0.05, 0.2)}

pytestmark = [pytest.mark.parametrize(("name", "variant"), CASES)]


@pytest.fixture(autouse=True)
def _network(name, monkeypatch):
    """Give metrics that look through a network random weights for it, and small images, since it takes its time.

    What is found in an image alone, by a network or by sampling far points, is not looked for again in another test.
    """
    monkeypatch.setattr(clouds, "sampled_clouds", sampled_once)
    monkeypatch.setitem(lidm_bev_matching.CELLS_PER_M, "r3dpa", 3)  # 20 take half a second for each scan
    if issubclass(load_metric(name), LabelMetric):
        monkeypatch.setattr(sys.modules[LabelMetric.__module__], "segmenter_of", lambda sensor, named: None)
    elif load_metric(name).needs_weights:
        monkeypatch.setenv("LIDARGRIT_WEIGHTS", str(weights_folder()))
        monkeypatch.setattr(PretrainedNetwork, "features", seen_once)
        monkeypatch.setattr(sys.modules[__name__], "SENSOR", SMALL)


FOUND: dict[tuple[str, bytes], np.ndarray] = {}


def found_once(kind, images, find):
    """Return what is found in each of some images, looking only at those that were not seen before, all at once."""
    keys = [(kind, np.asarray(image).tobytes()) for image in images]
    new = {key: at for at, key in enumerate(keys) if key not in FOUND}
    if new:
        FOUND.update(zip(new, find(images[[*new.values()]]), strict=True))
    return np.stack([FOUND[key] for key in keys])


def seen_once(network, images):
    return found_once(network.name, images.float(), network._forward)


SAMPLED = clouds.sampled_clouds


def sampled_once(points, variant):
    return found_once(variant, points, lambda some: SAMPLED(some, variant))


def scenes(seed, count=10, walls=6, drop_share=0.1, noise_m=0.0):
    """Ground and walls of random distance: fewer walls, wider ones; the noise comes from another seed.

    The noise reaches all that a metric may look at: what it takes beyond the limits drops, and brightness varies too.
    """
    return scenes_of(SENSOR, seed, count, walls, drop_share, noise_m)


@functools.lru_cache(50)
def scenes_of(sensor, seed, count, walls, drop_share, noise_m):
    rng = torch.Generator().manual_seed(seed)
    ground_m = 1.7 / torch.sin(-sensor.elevation_rad.clamp(max=-0.01))  # (H, 1)
    wall_m = (5 + 60 * torch.rand(count, walls, generator=rng)).repeat_interleave(sensor.width // walls + 1, dim=1)[
        :, None, : sensor.width
    ]
    shift = int(torch.randint(128, (1,), generator=rng))
    of_wall = torch.tensor([10, 50, 80, 70, 30, 71]).repeat(walls)[:walls].repeat_interleave(sensor.width // walls + 1)
    label = torch.where(ground_m < wall_m, 40, of_wall[: sensor.width]).roll(shift, dims=2)
    range_m = torch.minimum(ground_m, wall_m).roll(shift, dims=2)
    mask = torch.rand(range_m.shape, generator=rng) > drop_share
    noise = torch.randn(range_m.shape, generator=torch.Generator().manual_seed(seed + 1000)) * noise_m
    noisy_m = range_m + noise
    mask &= (noisy_m >= sensor.range_min_m) & (noisy_m <= sensor.range_max_m)
    reflectance = ((range_m / 100 + drop_share) + noise / 50).clamp(0, 1)
    range_m = noisy_m.clamp(sensor.range_min_m, sensor.range_max_m)
    return RangeImage.masked(range_m, mask, sensor, {"reflectance": reflectance, "label": label})


def score(name, variant, generated, real, **options):
    metric = load_metric(name)(variant=variant, **options)
    metric.update(generated, real=False)
    metric.update(real, real=True)
    return metric.compute()


@functools.cache
def at_once(name, variant):
    """Return the score of the same two sets that several tests score in other ways."""
    return score(name, variant, scenes(0), scenes(1))


@functools.cache
def of_equal_sets(name, variant):
    return score(name, variant, scenes(1), scenes(1)).value


def close(first: MetricResult, second: MetricResult):
    return np.isclose(first.value, second.value, rtol=1e-4, atol=1e-7)


def test_result_describes_itself(name, variant):
    result = score(name, variant, scenes(0), scenes(1)[:8])
    metric = load_metric(name)
    assert (result.metric, result.variant) == (name, variant)
    assert (result.num_generated, result.num_reference) == (10, 8)
    assert result.higher_is_better is metric.higher_is_better
    low, high = metric.bounds
    assert np.isfinite(result.value)
    assert low <= result.value <= high
    assert metric.title
    assert "\n" not in metric.title
    assert metric().variant == metric.variants[0]


def test_a_set_is_nearer_to_itself_than_to_another_kind(name, variant):
    same = of_equal_sets(name, variant)
    # Walls and drops of any kind leave no return in mid-air, or before a surface: noise must.
    noise_m = 1.0 if name in {"flying_points", "thin_object_rate_per_range"} else 0.0
    other = score(name, variant, scenes(0), scenes(1, walls=40, drop_share=0.5, noise_m=noise_m)).value
    assert same > other if load_metric(name).higher_is_better else same < other


def test_a_metric_that_does_not_score_0_for_equal_sets_says_why(name, variant):
    value, best = of_equal_sets(name, variant), float(load_metric(name).higher_is_better)
    assert (value > best + 1e-6) == (variant in load_metric(name).of_equal_sets)


def test_grows_with_noise(name, variant):
    real = scenes(1, count=16)  # of fewer, chance would show
    levels_m = (0.0, *NOISE_M.get(name, (8.0, 15.0)))
    values = [score(name, variant, scenes(0, count=16, noise_m=noise_m), real).value for noise_m in levels_m]
    low, high = load_metric(name).bounds
    assert all(low <= value <= high for value in values)
    if load_metric(name).higher_is_better:
        values = values[::-1]
    assert values == sorted(values)
    assert len(set(values)) == 3


def test_order_of_images_does_not_matter(name, variant):
    generated, real = scenes(0), scenes(1)
    order = torch.randperm(10, generator=torch.Generator().manual_seed(0))
    shuffled = real[order.tolist()]
    assert close(at_once(name, variant), score(name, variant, generated, shuffled))


def test_fed_in_pieces_and_computed_between_is_fed_at_once(name, variant):
    generated, real = scenes(0), scenes(1)
    pieces = load_metric(name)(variant=variant)
    for start, stop in ((0, 1), (1, 6), (6, 10)):
        pieces.update(real[start:stop], real=True)
        pieces.update(generated[start:stop], real=False)
        if stop == 6:
            assert pieces.compute() == pieces.compute()
    assert close(pieces.compute(), at_once(name, variant))


@pytest.mark.parametrize("columns", [1, 4])
def test_few_columns_are_scored_or_refused(name, variant, columns, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "SENSOR", SENSOR.with_columns(columns))
    found = 0.0
    with contextlib.suppress(ConfigError, DataError):  # any other error would be a traceback for the user
        found = score(name, variant, scenes(0, walls=1), scenes(1, walls=1)).value
    assert np.isfinite(found)


def test_one_image_without_a_batch_axis_is_a_batch_of_one(name, variant):
    metric = load_metric(name)(variant=variant)
    generated, real = scenes(0)[:3], scenes(1)[:3]
    metric.update(real, real=True)
    for index in range(3):
        metric.update(generated[index], real=False)
    assert close(metric.compute(), score(name, variant, generated, real))


def test_several_processes_are_one(name, variant):
    """To the last bit."""
    generated, real = scenes(0), scenes(1)
    parts, whole, merged = [], load_metric(name)(variant=variant), load_metric(name)(variant=variant)
    for start, stop in ((0, 3), (3, 3), (3, 10)):  # the second process got nothing to do
        part = load_metric(name)(variant=variant)
        part.first_image = start
        if start < stop:
            for metric in (part, whole):
                metric.update(generated[start:stop], real=False)
                metric.update(real[start:stop], real=True)
        parts.append(pickle.loads(pickle.dumps(part)))
        merged.merge(parts[-1])
    parts[0].update(generated[3:], real=False)  # merging has left the parts their own
    result = merged.compute()
    assert close(result, at_once(name, variant))
    if not name.startswith("frechet"):  # sums of rounded means differ in the last digit
        assert result == whole.compute()


def test_the_same_seed_gives_the_same_value_and_leaves_inputs_and_the_global_random_state_alone(name, variant):
    generated, real = scenes(0), scenes(1)
    before = [image.clone() for image in (generated.range_m, generated.return_mask, real.range_m, real.return_mask)]
    torch_state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    assert score(name, variant, generated, real) == at_once(name, variant)
    after = (generated.range_m, generated.return_mask, real.range_m, real.return_mask)
    assert all(torch.equal(x, y) for x, y in zip(before, after, strict=True))
    assert torch.equal(torch.get_rng_state(), torch_state)
    assert np.array_equal(np.random.get_state()[1], numpy_state)  # noqa: NPY002


def test_too_few_images_are_refused_by_name(name, variant):
    metric = load_metric(name)(variant=variant)
    metric.update(scenes(0, count=2), real=False)
    with pytest.raises(DataError, match=f"2 generated and 0 real range images for '{name}'"):
        metric.compute()


def test_other_options_are_not_merged(name, variant):
    with pytest.raises(ConfigError, match="make the metric with the same options in every process"):
        load_metric(name)(variant=variant).merge(load_metric(name)(variant=variant, seed=1))


def test_unknown_names_are_refused_with_neighbours(name, variant):
    with pytest.raises(UnknownNameError, match=f"wanted one such as .*{name}"):
        load_metric(name + "x")

    class Known(Metric):
        title, variants, accumulator = "", (variant,), SumAccumulator
        extractor = summarise = compare = lambda self: None

    with pytest.raises(ConfigError, match=f"got variant 'nonsense'.*wanted '{variant}'"):
        Known(variant="nonsense")
