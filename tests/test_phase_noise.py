"""Random numbers of masks: correlated within a phase as was learned, independent between phases, always uniform."""

import math

import pytest
import torch
from scipy.integrate import quad
from scipy.stats import kstest, norm
from torch import Tensor

from lidargrit.core.errors import ConfigError
from lidargrit.generation.pixel_decoder import phase_noise
from lidargrit.generation.pixel_decoder.phase_noise import PhaseNoise, following
from lidargrit.generation.pixel_decoder.pixel_decoder import PixelSampling
from lidargrit.generation.pixel_decoder.pixel_phases import Phase, phases_of
from lidargrit.scans.types import RangeImage
from pixel_decoder_examples import random_decoded, random_decoder, random_images, tiny_sensor

PHASES = phases_of(4)
HEIGHT, WIDTH = 32, 128


def of_phase(noise: PhaseNoise, phase: Phase, logit: float, scans: int, seed: int = 0) -> Tensor:
    """Return masks of one phase that are sampled with one probability everywhere, by the noise."""
    rng = torch.Generator().manual_seed(seed)
    uniform = torch.stack([noise(torch.rand(HEIGHT, WIDTH, generator=rng), rng, noise.shares()) for _ in range(scans)])
    return (uniform < torch.tensor(logit).sigmoid())[(..., *phase.pixels)]


def with_shares(phase: Phase, down: float, along: float) -> PhaseNoise:
    """Return a noise that has learned, from as many pixels as wanted, shares of one phase."""
    noise = PhaseNoise(PHASES)
    correlations = 0.6 * torch.tensor([down, along])
    terms = torch.tensor([1.0, 0.2, 0.1, 0.05]) * 1e9  # so many that what is assumed before them does not count
    powers = torch.stack([correlations**term for term in range(1, 5)], -1)
    noise.sums[PHASES.index(phase), :, 0] = (powers * terms).sum(-1)
    noise.sums[PHASES.index(phase), :, 1:] = terms
    return noise


def test_nothing_learned_leaves_the_numbers_as_they_are() -> None:
    uniform = torch.rand(HEIGHT, WIDTH)
    rng = torch.Generator().manual_seed(0)
    before = rng.get_state()
    nothing = PhaseNoise(PHASES)
    assert nothing(uniform, rng, nothing.shares()) is uniform
    learned = with_shares(PHASES[-1], 0.5, 0.1)
    assert learned(uniform, rng, learned.shares(strength=0.0)) is uniform
    assert torch.equal(rng.get_state(), before)


def test_numbers_stay_uniform_and_are_correlated_within_their_phase_alone() -> None:
    phase = PHASES[4]
    noise = with_shares(phase, 0.5, 0.2)
    rng = torch.Generator().manual_seed(1)
    numbers = torch.stack([noise(torch.rand(HEIGHT, WIDTH, generator=rng), rng, noise.shares()) for _ in range(100)])
    normal = torch.special.ndtri(numbers.double())
    own = normal[(..., *phase.pixels)]
    assert own.mean() == pytest.approx(0, abs=0.02)
    assert own.std() == pytest.approx(1, abs=0.02)
    assert kstest(numbers[:, 1::4, 1::4].flatten()[::7].numpy(), "uniform").pvalue > 1e-3
    assert (own[:, 1:] * own[:, :-1]).mean() == pytest.approx(0.5 * 0.6, abs=0.02)
    assert (own[:, 2:] * own[:, :-2]).mean() == pytest.approx(0.5 * 0.36, abs=0.02)
    assert (own * own.roll(1, -1)).mean() == pytest.approx(0.2 * 0.6, abs=0.02)
    assert (own[..., 0] * own[..., -1]).mean() == pytest.approx(0.2 * 0.6, abs=0.03)  # columns close a circle
    assert (own[:, 0] * own[:, -1]).mean() == pytest.approx(0, abs=0.03)  # rows do not
    other = normal[(..., *PHASES[5].pixels)]
    assert (other[:, 1:] * other[:, :-1]).mean() == pytest.approx(0, abs=0.02)
    assert (own * other).mean() == pytest.approx(0, abs=0.02)


@pytest.mark.parametrize("logit", [0.0, 1.5])
def test_shares_are_learned_from_masks_that_have_them(logit: float) -> None:
    phase = PHASES[4]
    masks = of_phase(with_shares(phase, 0.5, 0.2), phase, logit, 400)
    learning = PhaseNoise(PHASES)
    learning.learn([phase], torch.full((1, *masks.shape), logit), masks[None])
    down, along = learning.shares()[PHASES.index(phase)].tolist()
    assert down == pytest.approx(0.5, abs=0.04)
    assert along == pytest.approx(0.2, abs=0.04)
    assert learning.shares()[PHASES.index(phase) + 1].tolist() == pytest.approx([0, 0], abs=1e-6)


def both_below(one: float, other: float, correlation: float) -> float:
    """Return the probability that two correlated normal numbers lie below two thresholds, by integrating over one."""
    rest = math.sqrt(1 - correlation**2)
    return quad(lambda x: norm.pdf(x) * norm.cdf((other - correlation * x) / rest), -12, one)[0]


@pytest.mark.parametrize("correlation", [0.1, 0.3, 0.5])
@pytest.mark.parametrize("thresholds", [(0.0, 0.0), (1.0, 0.7), (-1.2, -0.8)])
def test_the_series_is_the_covariance_of_two_pixels(correlation: float, thresholds: tuple[float, float]) -> None:
    upper, lower = (float(norm.cdf(threshold)) for threshold in thresholds)
    both = both_below(*thresholds, correlation)
    pairs = {(True, True): both, (True, False): upper - both, (False, True): lower - both}
    pairs[False, False] = 1 - sum(pairs.values())
    logits, noise = torch.tensor([upper, lower]).logit()[None, None, :, None], PhaseNoise(PHASES)
    for returned, share in pairs.items():  # as if every pair had been seen as often as it is likely
        seen = PhaseNoise(PHASES)
        seen.learn(PHASES[-1:], logits, torch.tensor(returned)[None, None, :, None])
        noise.sums += 1e6 * share * seen.sums
    assert float(noise.correlations()[-1, 0]) == pytest.approx(correlation, rel=0.02)


def test_pixels_with_infinite_logits_are_left_out() -> None:
    phase = PHASES[-1]
    logits = torch.randn(1, 8, 4, 8, generator=torch.Generator().manual_seed(2))
    returned = torch.rand(1, 8, 4, 8) < 0.5
    out, some = logits.clone(), PhaseNoise(PHASES)
    out[:, 4:] = math.inf
    some.learn([phase], out, returned)
    half = PhaseNoise(PHASES)
    half.learn([phase], logits[:, :4], returned[:, :4])
    assert torch.allclose(some.sums, half.sums, rtol=1e-5)


def test_too_large_shares_keep_a_part_of_each_pixels_own() -> None:
    noise = with_shares(PHASES[-1], 0.8, 0.8)
    assert noise.shares()[-1].sum() == pytest.approx(0.9)
    numbers = noise(torch.rand(HEIGHT, WIDTH), torch.Generator().manual_seed(0), noise.shares(strength=50.0))
    assert numbers.isfinite().all()


def test_one_column_is_not_its_own_neighbour() -> None:
    noise, rng = PhaseNoise(PHASES), torch.Generator().manual_seed(3)
    noise.learn(PHASES[-1:], torch.zeros(1, 2000, 4, 1), torch.rand(1, 2000, 4, 1, generator=rng) < 0.5)
    assert noise.shares()[-1, 1] == pytest.approx(0, abs=1e-5)


def test_only_phases_that_were_taken_forget() -> None:
    noise, rng = PhaseNoise(PHASES), torch.Generator().manual_seed(4)
    scans, taken = 200, PHASES[-1:]

    def learn() -> Tensor:
        noise.learn(taken, torch.zeros(1, scans, 4, 8), torch.rand(1, scans, 4, 8, generator=rng) < 0.5)
        return noise.sums.clone()

    noise.sums.fill_(1.0)
    before = noise.sums.clone()
    after = learn()
    assert torch.equal(after[:-1], before[:-1])
    fresh = PhaseNoise(PHASES)
    rng.manual_seed(4)
    fresh.learn(taken, torch.zeros(1, scans, 4, 8), torch.rand(1, scans, 4, 8, generator=rng) < 0.5)
    assert torch.allclose(after[-1], 0.5 + fresh.sums[-1], atol=1e-4)  # half of it after as many scans as 200


def test_four_processes_forget_as_one_that_has_all_of_their_scans(monkeypatch) -> None:
    rng = torch.Generator().manual_seed(4)
    seen = torch.rand(20, 1, 8, 4, 8, generator=rng) < 0.5
    alone, shared = PhaseNoise(PHASES), PhaseNoise(PHASES)
    for batch in seen:
        alone.learn(PHASES[-1:], torch.zeros(1, 32, 4, 8), batch.repeat(1, 4, 1, 1))
    monkeypatch.setattr(phase_noise, "sum_over_processes", lambda counted: 4 * counted)
    for batch in seen:
        shared.learn(PHASES[-1:], torch.zeros(1, 8, 4, 8), batch)
    assert torch.allclose(alone.sums, shared.sums)


@torch.no_grad()
def test_training_learns_the_noise_of_masks_and_sampling_follows_it() -> None:
    sensor = tiny_sensor(16, 32)
    decoder, decoded = random_decoder(sensor, 4, spread=0.02), random_decoded(sensor, 8)
    images = random_images(sensor, 8)
    rows_alike = images.return_mask[:, ::4].repeat_interleave(4, 1)  # so that drops are as high as four rows
    images = RangeImage.masked(images.range_m + 1, rows_alike, sensor)

    def sample(correlation: float) -> RangeImage:
        rngs = [torch.Generator().manual_seed(seed) for seed in range(8)]
        return decoder.sample(decoded, rngs, PixelSampling(mask_correlation=correlation))

    before = sample(2.0)
    decoder.estimate(decoded, images, torch.Generator().manual_seed(0))
    assert not decoder.mask.noise.sums.any()
    assert torch.equal(sample(0.0).return_mask, before.return_mask)
    for step in range(20):
        decoder.train().estimate(decoded, images, torch.Generator().manual_seed(step))
    decoder.eval()
    assert decoder.mask.noise.correlations()[-3, 0] > 0.3
    assert torch.equal(sample(0.0).return_mask, before.return_mask)
    assert not torch.equal(sample(2.0).return_mask, before.return_mask)
    copied = random_decoder(sensor, 4)
    copied.load_state_dict(decoder.state_dict())
    assert torch.equal(copied.mask.noise.sums, decoder.mask.noise.sums)


def test_a_negative_correlation_of_masks_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"mask_correlation=-1\.0"):
        PixelSampling(mask_correlation=-1.0)


def test_numbers_of_neighbouring_columns_correlate_and_stay_uniform():
    rng = torch.Generator().manual_seed(0)
    own = [torch.rand((64, 512), generator=rng) for _ in range(4)]
    found = [following(own[at], own[:at]) for at in range(4)]
    assert torch.equal(found[0], own[0]), "the first image is as it is alone"
    normal = torch.stack([torch.special.ndtri(one.double()).flatten() for one in found])
    wanted = 0.6 ** (torch.arange(4)[:, None] - torch.arange(4)).abs().double()
    assert torch.corrcoef(normal).numpy() == pytest.approx(wanted.numpy(), abs=0.015)
    for one in found:
        assert float(one.min()) >= 0
        assert float(one.max()) < 1
        ends = torch.linspace(0, 1, 11)
        assert torch.histogram(one.flatten(), ends).hist.numpy() == pytest.approx(64 * 51.2, rel=0.06)
