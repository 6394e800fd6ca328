"""The codebook against the reference program, and its own additions."""

import math
import re

import pytest
import torch
import torch.nn.functional as F

from lidargrit.nn.codebook import VectorQuantiser


@pytest.mark.shared
@pytest.mark.parametrize(("loss", "key"), [("reference", "legacy"), ("vqvae", "fixed")])
def test_codes_loss_and_gradients_are_the_programs(golden, loss, key):
    data = {name: torch.from_numpy(value) for name, value in golden("quantiser").items()}
    quantiser = VectorQuantiser(*data["codebook"].shape, loss=loss, restart_dead=False).eval()
    quantiser.embedding.weight.data.copy_(data["codebook"])
    z = data["z"].clone().requires_grad_()
    quantised = quantiser(z)
    assert torch.equal(quantised.tokens, data["indices"])
    assert torch.allclose(quantised.latents, data["z_q"], atol=1e-6)
    assert torch.allclose(quantised.loss, data[f"{key}_loss"], atol=1e-6)
    (quantised.loss + (quantised.latents * data["upstream_grad"]).sum()).backward()
    assert torch.allclose(z.grad, data[f"{key}_grad_z"], atol=1e-6)
    assert torch.allclose(quantiser.embedding.weight.grad, data[f"{key}_grad_codebook"], atol=1e-6)


def test_the_nearest_code_is_that_of_a_slow_loop():
    torch.manual_seed(0)
    quantiser = VectorQuantiser(7, 3, loss="paper", restart_dead=False)
    quantiser.embedding.weight.data.normal_()
    flat = torch.randn(40, 3)
    codes = quantiser.embedding.weight.detach()
    slow = [min(range(7), key=lambda k, z=z: float(((z - codes[k]) ** 2).sum())) for z in flat]
    assert quantiser.nearest(flat).tolist() == slow


def test_the_papers_loss_weighs_both_terms_alike():
    torch.manual_seed(0)
    quantiser = VectorQuantiser(5, 4, loss="paper", restart_dead=False).eval()
    z = torch.randn(2, 4, 3, 3, requires_grad=True)
    quantised = quantiser(z)
    assert torch.allclose(quantised.loss, 2 * F.mse_loss(quantised.latents, z), rtol=1e-5)


def test_codes_that_follow_means_reach_the_means_of_clusters():
    torch.manual_seed(0)
    centres = torch.tensor([[5.0, 0.0], [-5.0, 0.0], [0.0, 5.0]])
    quantiser = VectorQuantiser(3, 2, loss="ema", restart_dead=True).train()
    rng = torch.Generator().manual_seed(0)
    for _ in range(1500):
        z = centres[torch.randint(3, (64,))] + 0.1 * torch.randn(64, 2)
        quantiser(z.T.reshape(1, 2, 8, 8), rng)
    distances = torch.cdist(centres, quantiser.embedding.weight).amin(dim=1)
    assert float(distances.max()) < 0.1
    assert float(quantiser.perplexity()) == pytest.approx(3, abs=0.2)


def test_a_collapsed_codebook_shows_and_restarting_cures_it():
    torch.manual_seed(0)
    rng = torch.Generator().manual_seed(0)
    z = 100 + torch.randn(4, 8, 16, 16)  # far from where the codes begin: one code wins everything
    collapsed = VectorQuantiser(64, 8, loss="paper", restart_dead=False).train()
    cured = VectorQuantiser(64, 8, loss="paper", restart_dead=True).train()
    for _ in range(20):
        collapsed(z, rng)
        cured(z, rng)
    assert collapsed.perplexity() < 3
    assert cured.perplexity() > 5 * collapsed.perplexity()
    assert cured.warnings("") == []
    assert re.fullmatch(
        r".* collapsed: [12]\.\d of 64 codes in effect, \d+% alive; the remedy: x", *collapsed.warnings("x")
    )


def test_perplexity_is_the_exponential_of_the_entropy():
    quantiser = VectorQuantiser(4, 2, loss="paper", restart_dead=False)
    quantiser.usage.copy_(torch.tensor([2.0, 1.0, 1.0, 0.0]))
    assert float(quantiser.perplexity()) == pytest.approx(math.exp(-(0.5 * math.log(0.5) + 2 * 0.25 * math.log(0.25))))
