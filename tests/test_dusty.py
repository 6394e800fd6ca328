"""DUSty: its raydrop, its game step by step, and the search for the latent of a scan."""

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidargrit.core.errors import ConfigError
from lidargrit.nn.latent_search import rate_share, search_latents
from lidargrit.scans.condition import Observed
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.systems.dusty.system import (
    Dusty,
    DustyConfig,
    DustySampling,
    InverseRange,
    logistic_noise,
    straight_through,
)
from lidargrit.training.engine import Engine

SENSOR = load_sensor("hdl64e_kitti_odometry")
NARROW = SENSOR.with_columns(32)
TINY = DustyConfig(latent_dim=8, channels=4, max_channels=8)


def made(config=TINY, sensor=NARROW):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return Dusty(config, sensor).eval()


@pytest.fixture(scope="module")
def images():
    return made(replace(TINY, variant="baseline")).sample([100, 101, 102, 103])


# --- what networks see, and raydrop


def test_ranges_are_encoded_as_in_the_program(images):
    encoding, near, far = InverseRange(NARROW), 0.9, 120.0
    encoded = encoding.encode(images)[:, 0]
    for row, column in ((0, 0), (20, 7), (63, 31)):
        metres = float(images.range_m[1, row, column])
        wanted = 2 * (1 / metres - 1 / far) / (1 / near - 1 / far) - 1 if metres else -1
        assert float(encoded[1, row, column]) == pytest.approx(wanted, abs=1e-5)
    assert bool((encoded[~images.return_mask] == -1).all())
    near_returns = images.return_mask & (images.range_m < 30)
    assert torch.allclose(encoding.decode(encoded)[near_returns], images.range_m[near_returns], rtol=1e-3)


def test_coins_fall_by_their_logits_and_pass_the_sigmoids_gradient():
    logits = torch.tensor([-2.0, 0.0, 1.0]).repeat_interleave(20_000).requires_grad_()
    noise = logistic_noise(tuple(logits.shape), torch.Generator().manual_seed(0))
    coins = straight_through(logits, noise)
    assert set(coins.tolist()) == {0.0, 1.0}
    assert coins.view(3, -1).mean(1).tolist() == pytest.approx([0.1192, 0.5, 0.7311], abs=0.012)
    coins.sum().backward()
    soft = torch.sigmoid(logits.detach() + noise)
    assert logits.grad is not None
    assert torch.allclose(logits.grad, soft * (1 - soft), atol=1e-6)


def test_raydrop_has_a_seed_of_its_own():
    generator = made()
    first, again, other = (generator.sample([4, 5], sampling=DustySampling(raydrop_seed=seed)) for seed in (0, 0, 1))
    assert torch.equal(first.range_m, again.range_m)
    both = first.return_mask & other.return_mask
    assert 0 < float(both.float().mean()) < float(first.return_mask.float().mean())
    assert torch.equal(first.range_m[both], other.range_m[both])


def test_masks_follow_the_logits():
    generator = made()
    with torch.no_grad():
        _, logits = generator.synthesis(generator._latents([4]))
        assert torch.equal(
            generator.sample([4], sampling=DustySampling(mask="threshold")).return_mask, logits[:, 0] > 0
        )
        sampled = torch.stack(
            [generator.sample([4], sampling=DustySampling(raydrop_seed=s)).return_mask[0] for s in range(400)]
        )
    assert torch.allclose(sampled.float().mean(0), logits[0, 0].sigmoid(), atol=0.13)  # five standard errors


def test_the_second_variant_drops_scans_as_a_whole():
    generator = made(replace(TINY, variant="dusty_2"))
    head = generator.synthesis.return_head
    head.weight.data.zero_()
    for gate, returns in ((30.0, True), (-30.0, False)):
        head.bias.data = torch.tensor([30.0, gate])
        assert bool((generator.sample([0]).return_mask == returns).all())
    head.bias.data = torch.tensor([30.0, 0.5])
    game = generator.objective("adversarial").train()
    rates = [float(game._generate_encoded(1, torch.Generator().manual_seed(seed))[1]) for seed in range(300)]
    assert set(rates) == {0.0, 1.0}  # one coin a scan while it learns
    assert np.mean(rates) == pytest.approx(1 / (1 + math.exp(-0.5)), abs=0.11)
    assert float(game.eval()._generate_encoded(1, torch.Generator().manual_seed(0))[1]) == 1.0  # and none after


def test_the_baseline_reads_far_pixels_as_no_return():
    generator = made(replace(TINY, variant="baseline"), SENSOR.with_columns(64))
    every = generator.sample([0, 1], sampling=DustySampling(tolerance=0.0))
    limit_m = 1 / (0.008 * (1 / 0.9 - 1 / 120) + 1 / 120)
    assert limit_m == pytest.approx(58.3, abs=0.1)  # what the docstring says
    near = generator.sample([0, 1])
    assert torch.equal(near.return_mask, every.range_m < limit_m)
    coarse = generator.sample([0, 1], sampling=DustySampling(tolerance=0.5))
    assert torch.equal(
        coarse.return_mask, (every.range_m < 1 / (0.5 * (1 / 0.9 - 1 / 120) + 1 / 120)) & every.return_mask
    )
    assert 0 < float(coarse.return_mask.float().mean()) < 1


def test_what_is_generated_at_the_far_limit_is_no_return():
    """No return and the far limit are one value to DUSty's networks, so that either may stand for the other."""
    generator = made()
    generator.synthesis.return_head.bias.data.fill_(30.0)
    assert bool(generator.sample([0]).return_mask.all())
    assert float(generator.sample([0], sampling=DustySampling(tolerance=0.5)).return_mask.float().mean()) < 1
    generator.synthesis.range_head.bias.data.fill_(-30.0)
    assert not bool(generator.sample([0]).return_mask.any())


def test_images_of_other_sizes_are_refused():
    for columns in (40, 8):
        with pytest.raises(ConfigError, match=r"rows and columns in multiples of 16"):
            Dusty(TINY, SENSOR.with_columns(columns))
    with pytest.raises(ConfigError, match="penalty_every=0"):
        DustyConfig(penalty_every=0)
    with pytest.raises(ConfigError, match="search_steps=0"):
        DustySampling(search_steps=0)


# --- the game


def game_of(**settings):
    with torch.random.fork_rng():
        torch.manual_seed(1)
        return made(replace(TINY, augmentations=(), **settings)).objective("adversarial").train()


def loss_of(game, images, phase):
    return float(game(Example(images), rng(), phase)["loss"].detach())


def rng():
    return torch.Generator().manual_seed(9)


def test_losses_are_the_formulas(images):
    game = game_of(penalty_weight=0.0)
    with torch.no_grad():
        real = game.discriminator(game.encoding.encode(images))
        generated = game.discriminator(game._generate_encoded(4, rng())[0])
    found = {phase: loss_of(game, images, phase) for phase in game.players}
    of_discriminator = (-real.sigmoid().log()).mean() - (1 - generated.sigmoid()).log().mean()
    assert found["discriminator"] == pytest.approx(float(of_discriminator), rel=1e-5)
    assert found["generator"] == pytest.approx(float(-generated.sigmoid().log().mean()), rel=1e-5)


def test_the_penalty_is_the_squared_gradient_at_real_images(images):
    plain, game = game_of(penalty_weight=0.0), game_of(penalty_weight=3.0, penalty_every=2)
    without = loss_of(plain, images, "discriminator")
    first, second = (game(Example(images), rng(), "discriminator") for _ in range(2))
    assert "squared_gradient" not in first
    assert float(first["loss"].detach()) == pytest.approx(without, rel=1e-6)
    wanted = without + 3.0 / 2 * 2 * float(second["squared_gradient"].detach())
    assert float(second["loss"].detach()) == pytest.approx(wanted, rel=1e-5)
    judge = copy.deepcopy(game.discriminator).double()
    real = game.encoding.encode(images[:1]).double()
    step = 1e-5 * torch.eye(real.numel(), dtype=torch.float64).view(-1, 1, *real.shape[-2:])
    with torch.no_grad():
        slopes = torch.cat([(judge(real + part) - judge(real - part)) / 2e-5 for part in step.split(256)])
    one = game_of(penalty_weight=3.0, penalty_every=1)(Example(images[:1]), rng(), "discriminator")["squared_gradient"]
    assert float(one.detach()) == pytest.approx(float(slopes.square().sum()), rel=1e-4)
    assert game.turns == 2
    game.eval()(Example(images), rng(), "discriminator")  # no penalty, so that it can be validated without gradients
    assert game.turns == 2


def test_each_player_moves_by_its_own_loss_against_the_other_as_it_stands(images):
    """The engine's one optimiser against two, stepped by hand."""
    game, slow = game_of(penalty_every=1), game_of(penalty_every=1)
    engine = Engine("fp32")
    engine.set_up(game, torch.optim.AdamW(game.parameters(), lr=0.01, betas=(0.0, 0.99), weight_decay=0.0))
    optimisers = {
        "discriminator": torch.optim.Adam(slow.discriminator.parameters(), lr=0.01, betas=(0.0, 0.99)),
        "generator": torch.optim.Adam(slow.synthesis.parameters(), lr=0.01, betas=(0.0, 0.99)),
    }
    start = {name: weight.clone() for name, weight in slow.state_dict().items()}
    for seed in range(3):
        terms = engine.step(Example(images), seed, gradient_clip=0.0)
        total = 0.0
        for phase, optimiser in optimisers.items():
            slow.zero_grad()
            loss = slow(Example(images), torch.Generator().manual_seed(seed), phase)["loss"]
            loss.backward()
            optimiser.step()
            total += float(loss.detach())
            assert float(terms[f"{phase}_loss"]) == pytest.approx(float(loss.detach()), rel=1e-5)
        assert float(terms["loss"]) == pytest.approx(total, rel=1e-5)
    for name, weight in game.state_dict().items():
        assert torch.allclose(weight, slow.state_dict()[name], atol=1e-5), name
        assert not torch.equal(weight, start[name])


def test_a_player_whose_loss_is_not_finite_does_not_move(images):
    game = game_of()
    game.synthesis.range_head.bias.data.fill_(torch.nan)
    engine = Engine("fp32")
    engine.set_up(game, torch.optim.SGD(game.parameters(), lr=1.0))
    before = {name: weight.clone() for name, weight in game.named_parameters()}
    assert not bool(engine.step(Example(images), 0, gradient_clip=1.0)["loss"].isfinite())
    assert all(torch.equal(weight, before[name]) for name, weight in game.named_parameters() if "bias" not in name)
    assert all(bool(weight.isfinite().all()) for weight in game.discriminator.parameters())


# --- the search


def test_a_search_finds_the_least_error_of_each_row():
    target = torch.randn(3, 6, generator=torch.Generator().manual_seed(2))
    target *= (6 / target.square().sum(1, keepdim=True)).sqrt()  # on the sphere
    noise = torch.randn(3, 301, 6, generator=torch.Generator().manual_seed(4))
    found = search_latents(lambda latents: (latents - target).abs().sum(1), noise, 0.1)
    assert torch.allclose(found, target, atol=0.02)
    alone = search_latents(lambda latents: (latents - target[1:2]).abs().sum(1), noise[1:2], 0.1)
    assert torch.allclose(alone, found[1:2], atol=1e-5)


def test_the_searchs_rate_rises_stays_and_falls():
    assert [rate_share(done) for done in (0.0, 0.025, 0.05, 0.5, 0.75)] == pytest.approx([0, 0.5, 1, 1, 1])
    assert [rate_share(done) for done in (0.875, 1.0)] == pytest.approx([0.5, 0.0])


def test_completion_keeps_what_was_observed():
    generator, sampling = made(), DustySampling(search_steps=150)
    whole = generator.sample([50, 51], sampling=sampling)
    observed = torch.zeros_like(whole.return_mask)
    observed[:, ::2] = True
    hidden = RangeImage.masked(whole.range_m, whole.return_mask & observed, NARROW)
    known = [Observed.of_pixels(images, observed) for images in (whole, hidden)]
    found, again = (generator.complete(each, [1, 2], sampling) for each in known)
    assert all(weight.grad is None for weight in generator.parameters())
    assert torch.equal(found.range_m, again.range_m)  # what was not observed is not looked at
    assert torch.equal(found.range_m[observed], whole.range_m[observed])
    both = ~observed & whole.return_mask & found.return_mask
    guess = generator.sample([1, 2], sampling=sampling)
    also = both & guess.return_mask
    error, of_guess = ((1 / image.range_m - 1 / whole.range_m)[also].abs().mean() for image in (found, guess))
    assert float(error) < 0.5 * float(of_guess)


def test_a_latent_is_searched_for_in_inference_mode_too(images):
    generator, sampling = made(), DustySampling(search_steps=2)
    known = Observed.of_pixels(images, torch.ones_like(images.return_mask))
    with torch.inference_mode():
        found = generator.complete(known, range(len(images)), sampling)
    assert torch.equal(found.range_m, generator.complete(known, range(len(images)), sampling).range_m)


def test_a_gradient_reaches_every_weight_of_the_player_alone(images):
    game = made(replace(TINY, variant="dusty_2")).objective("adversarial").train()
    for phase, mine in (("discriminator", "discriminator."), ("generator", "synthesis.")):
        game.zero_grad()
        game(Example(images), rng(), phase)["loss"].backward()
        reached = {name for name, weight in game.named_parameters() if weight.grad is not None}
        assert reached == {name for name, _ in game.named_parameters() if name.startswith(mine)}
