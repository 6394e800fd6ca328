"""Principal axes of a codebook, in which LiDM's diffusion takes the latents of another tokenizer."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from lidargrit.core.errors import ConfigError
from lidargrit.generation.tokenizers.vqvae import VqvaeConfig
from lidargrit.scans.example import Example
from lidargrit.systems.lidm.system import LatentAxes, Lidm, LidmConfig
from test_lidm import SENSOR, SMALL, made, walls

CONFIG = LidmConfig(VqvaeConfig(32, (1, 1, 1), code_dim=8, num_codes=32), SMALL.denoiser, latent_axes=2)


def codes_in_a_plane(count: int = 32) -> torch.Tensor:
    """Return codes of 8 numbers that differ along two axes, along one eight times as much as along the other."""
    rng = torch.Generator().manual_seed(1)
    axes = torch.linalg.qr(torch.randn(8, 2, generator=rng))[0]
    return 3 + (torch.randn(count, 2, generator=rng) * torch.tensor([4.0, 0.5])) @ axes.T


def test_axes_are_those_of_the_weighted_covariance():
    codes, rng = codes_in_a_plane(), np.random.default_rng(0)
    share = torch.from_numpy(rng.dirichlet(np.ones(32))).float()
    axes = LatentAxes(8, 2)
    axes.fit(codes, share)
    covariance = np.cov(codes.double().numpy().T, aweights=share.double().numpy(), ddof=0)
    variance = np.linalg.eigvalsh(covariance)[::-1]
    assert torch.allclose(axes.scale.double(), torch.from_numpy(variance[:2].copy()).sqrt(), rtol=1e-3)
    latents = codes.T[None, :, :, None].contiguous()  # (1, 8, 32, 1)
    along = axes(latents)
    assert torch.allclose((along[0, :, :, 0] * share).sum(1), torch.zeros(2), atol=1e-4)
    assert torch.allclose((along[0, :, :, 0].square() * share).sum(1), torch.ones(2), atol=1e-3)
    assert torch.allclose(axes.latents(along), latents, atol=1e-4), "codes in a plane come back"


def test_scans_are_sampled_by_the_axes_of_the_codes():
    generator, images = made(CONFIG), walls()
    with torch.no_grad():
        generator.tokenizer.quantize.embedding.weight.copy_(codes_in_a_plane())
    assert generator.latent_shape[0] == 2
    objective = generator.objective("denoiser")
    with torch.no_grad():
        terms = objective(Example(images), torch.Generator().manual_seed(0))
    assert bool(terms["loss"].isfinite())
    assert float(generator.axes.scale.std()) == 0, "asking for an objective changes nothing"
    generator.load_stage("denoiser", objective)
    again = Lidm(CONFIG, SENSOR).eval()
    again.load_state_dict(generator.state_dict())
    assert torch.equal(again.sample([3]).range_m, generator.sample([3]).range_m)
    assert generator.sample([3]).return_mask.any()


@pytest.mark.parametrize("change", [{"latent_axes": 9}, {"latent_axes": -1}, {"scale_latents": True}])
def test_axes_that_cannot_be_are_refused(change):
    with pytest.raises(ConfigError, match=r"for latents of 8 channels; wanted 0 to as many axes"):
        Lidm(replace(CONFIG, **change), SENSOR)
