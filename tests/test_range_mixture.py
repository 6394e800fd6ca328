"""The mixture of a range: a density between the sensor's limits, its steps, and samples at a temperature."""

import math
from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor

from lidargrit.generation.pixel_decoder.range_mixture import RangeMixture
from lidargrit.generation.range_steps import RangeSteps
from lidargrit.scans.sensors import load_sensor
from mixture_loops import density_of_v, mass_between

SENSOR = load_sensor("hdl64e_kitti_odometry")


def mixture_of(seed: int) -> RangeMixture:
    rng = torch.Generator().manual_seed(seed)
    size = (1, 6)
    centres = torch.linspace(math.log1p(1.0), math.log1p(80.0), 6).expand(size)
    log_scales = torch.empty(size).uniform_(-4, 0.5, generator=rng)
    return RangeMixture(torch.randn(size, generator=rng), centres, log_scales, (1.0, 80.0))


@pytest.mark.parametrize("seed", range(4))
def test_a_density_integrates_to_one_between_the_sensors_limits(seed: int) -> None:
    mixture = mixture_of(seed)
    range_m = torch.linspace(1, 80, 200_001)
    many = expanded(mixture, len(range_m))
    density = many.log_density(range_m).double().exp()
    assert float(torch.trapezoid(density, range_m.double())) == pytest.approx(1, abs=2e-3)
    cdf = distribution_function(many, range_m).double()
    assert float(cdf[0]) == pytest.approx(0, abs=1e-5)
    assert float(cdf[-1]) == pytest.approx(1, abs=1e-5)
    for first, last in ((1000, 1400), (20_000, 60_000), (100_000, 199_000)):
        area = torch.trapezoid(density[first : last + 1], range_m[first : last + 1].double())
        assert float(cdf[last] - cdf[first]) == pytest.approx(float(area), abs=1e-3)


def distribution_function(mixture: RangeMixture, range_m: Tensor) -> Tensor:
    v = torch.stack([torch.full_like(range_m, limit) for limit in mixture.limits_m] + [range_m]).double().log1p()
    low, high, below = ((v[..., None] - mixture.centres) / mixture.log_scales.exp()).sigmoid()
    return (mixture.logits.softmax(-1) * (below - low) / (high - low)).sum(-1)


def expanded(mixture: RangeMixture, count: int) -> RangeMixture:
    logits, centres, log_scales = (
        part.expand(count, -1) for part in (mixture.logits, mixture.centres, mixture.log_scales)
    )
    return RangeMixture(logits, centres, log_scales, mixture.limits_m)


def test_sampled_ranges_follow_the_distribution_function() -> None:
    count = 20_000
    mixture = mixture_of(1)
    many = expanded(mixture, count)
    rng = torch.Generator().manual_seed(5)
    component, within = torch.rand(2, count, generator=rng)
    range_m = many.sample(component, within)
    assert float(range_m.min()) >= 1
    assert float(range_m.max()) <= 80
    level = distribution_function(many, range_m).sort().values
    expected = (torch.arange(count) + 0.5) / count
    assert float((level - expected).abs().max()) < 1.63 / math.sqrt(count)  # Kolmogorov and Smirnov, 1 %


def test_sharpening_narrows_the_spread_and_leaves_surfaces_their_probabilities() -> None:
    mixture = RangeMixture(
        torch.tensor([[1.0, 0.0]]).expand(4000, -1),
        torch.tensor([[2.0, 3.0]]).expand(4000, -1),
        torch.tensor([[-4.0, -8.0]]).expand(4000, -1),  # a broad one, and behind it a wall that is known exactly
        (1.0, 80.0),
    )
    component, within = torch.rand(2, 4000, generator=torch.Generator().manual_seed(0))
    plain, sharp = mixture.sample(component, within), mixture.sample(component, within, temperature=0.3, noise=0.5)
    near_plain, near_sharp = plain.log1p() < 2.5, sharp.log1p() < 2.5
    assert float(near_plain.float().mean()) == pytest.approx(1 / (1 + math.exp(-1)), abs=0.03)
    assert torch.equal(near_sharp, near_plain)
    assert float(sharp[near_sharp].std()) == pytest.approx(0.5 * float(plain[near_plain].std()), rel=0.1)


def test_sharpening_prefers_the_denser_component_of_a_surface() -> None:
    mixture = expanded(
        RangeMixture(
            torch.zeros(1, 3), torch.tensor([[2.03, 2.0, 3.0]]), torch.tensor([[-4.0, -7.0, -5.0]]), (1.0, 80.0)
        ),
        8000,
    )
    component, within = torch.rand(2, 8000, generator=torch.Generator().manual_seed(0))
    at_dense = [
        float(((mixture.sample(component, within, temperature, noise=1e-9).log1p() - 2).abs() < 0.01).float().mean())
        for temperature in (1.0, 0.4)
    ]
    assert at_dense == pytest.approx([1 / 3, 2 / 3], abs=0.02)


@pytest.mark.parametrize("apart", [-0.3, 0.3])
def test_a_thin_object_keeps_its_probability_before_and_behind_a_wall(apart: float) -> None:
    logits, log_scales = torch.tensor([[0.1, 0.9]]).log(), torch.tensor([[0.02, 0.003]]).log()
    mixture = RangeMixture(logits, torch.tensor([[3.0 + apart, 3.0]]), log_scales, (1.0, 80.0))
    assert shares_of_components(mixture, 0.35)[0] == pytest.approx(0.1, abs=0.005)
    # Much colder, one that is so vague that the wall lies within its spread is lost: in front as well as behind.
    vague = RangeMixture(logits, mixture.centres, torch.tensor([[0.1, 0.01]]).log(), (1.0, 80.0))
    assert shares_of_components(vague, 0.1)[0] == 0
    assert tempered_by_a_loop(vague, 0.1)[0] < 1e-6


@pytest.mark.parametrize("of_surfaces", [0.4, 1.0, 3.0])
@pytest.mark.parametrize("temperature", [0.1, 0.35, 1.0, 2.0])
@pytest.mark.parametrize("seed", range(3))
def test_components_are_sharpened_by_the_density_on_their_surface_and_its_probability(
    seed: int, temperature: float, of_surfaces: float
) -> None:
    rng = torch.Generator().manual_seed(seed)
    centres = torch.tensor([[math.log1p(1.0), 1.5, 1.54, 1.59, 1.65, 2.4, 3.5, math.log1p(80.0)]])
    log_scales = torch.cat(
        [torch.tensor([[-3.0]]), torch.empty(1, 6).uniform_(-5, -1, generator=rng), torch.ones(1, 1)], -1
    )
    logits = torch.randn(1, 8, generator=rng)
    logits[0, 5] -= 10
    mixture = RangeMixture(logits, centres, log_scales, (1.0, 80.0))
    found = shares_of_components(mixture, temperature, of_surfaces)
    np.testing.assert_allclose(found, tempered_by_a_loop(mixture, temperature, of_surfaces), atol=1e-3)


def shares_of_components(mixture: RangeMixture, temperature: float, of_surfaces: float = 1.0) -> list[float]:
    """How often each component is sampled: without noise every range is the centre of its component."""
    count = 20_000
    component, within = (torch.arange(count) + 0.5) / count, torch.full((count,), 0.5)
    v = expanded(mixture, count).sample(component, within, temperature, 1e-9, of_surfaces).log1p()
    return [float(((v - centre).abs() < 0.01).float().mean()) for centre in mixture.centres[0].tolist()]


def tempered_by_a_loop(mixture: RangeMixture, temperature: float, of_surfaces: float = 1.0) -> list[float]:
    weights, power = mixture.logits[0].double().softmax(-1).tolist(), 1 / temperature - 1
    parts = list(zip(weights, mixture.centres[0].tolist(), mixture.log_scales[0].exp().tolist(), strict=True))
    density = partial(density_of_v, parts, mixture.limits_m)
    tempered = []
    for weight, centre, _ in parts:
        there = [w * mass_between(centre - 0.1, centre + 0.1, c, scale) for w, c, scale in parts]
        mean = sum(m * density(c) ** power for m, (_, c, _) in zip(there, parts, strict=True)) / sum(there)
        tempered.append(weight * density(centre) ** power / mean * sum(there) ** (1 / of_surfaces - 1))
    return [one / sum(tempered) for one in tempered]


def test_a_component_of_no_weight_is_not_sampled_at_any_temperature() -> None:
    parts = torch.tensor([[0.0, -200.0]]), torch.tensor([[2.0, 3.0]]), torch.tensor([[-4.0, -4.0]])
    component, within = torch.rand(2, 1000, generator=torch.Generator().manual_seed(0))
    for temperature in (0.5, 1.0, 2.0):
        v = expanded(RangeMixture(*parts, (1.0, 80.0)), 1000).sample(component, within, temperature).log1p()
        assert float(v.max()) < 2.5


def test_all_steps_of_a_range_are_sure_to_hold_it():
    steps = RangeSteps(SENSOR, 500)
    every = torch.arange(steps.first, steps.last + 1).expand(4, -1)
    rng = torch.Generator().manual_seed(0)
    logits, centres, scales = (torch.randn(4, 1, 3, generator=rng).expand(*every.shape, 3) for _ in range(3))
    limits_m = (SENSOR.range_min_m, SENSOR.range_max_m)
    mixture = RangeMixture(logits, 2.5 + centres, scales - 3, limits_m)
    mass = mixture.log_mass(*steps.edges_m(every)).exp()
    assert torch.allclose(mass.sum(-1), torch.ones(4, dtype=mass.dtype), atol=1e-5)
    assert torch.equal(steps.indices(steps.range_m(every)), every)


def test_the_expected_bits_are_the_mean_over_all_steps():
    steps, rng = RangeSteps(SENSOR, 20), torch.Generator().manual_seed(0)
    logits, centres, scales = (torch.randn(100, 8, generator=rng) for _ in range(3))
    limits_m = (SENSOR.range_min_m, SENSOR.range_max_m)
    mixture = RangeMixture(logits, 2.5 + centres.clamp(-1, 1), 0.7 * scales - 4.5, limits_m)
    every = torch.arange(steps.first, steps.last + 1).expand(100, -1)
    parts = mixture.logits, mixture.centres, mixture.log_scales
    logits, centres, scales = (part[:, None].expand(*every.shape, 8) for part in parts)
    nats = -RangeMixture(logits, centres, scales, limits_m).log_mass(*steps.edges_m(every))
    error = mixture.entropy(steps).double() - (nats.exp().reciprocal() * nats).sum(-1)
    assert float(error.abs().max()) < 0.1
    assert abs(float(error.mean())) < 0.006, "the anomaly of a scan is a sum over its pixels"
