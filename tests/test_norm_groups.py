"""Groups of the norms of small networks, which must not take away what an image has in the mean."""

from dataclasses import replace

import pytest
import torch

from lidargrit.generation.presets import load_preset
from lidargrit.systems.lidm.latent_unet import LatentUnet


@pytest.mark.parametrize("preset", ["lidm_small", "lidm_small_shared"])
def test_a_small_denoiser_sees_latents_that_are_too_high_as_a_whole(preset):
    """A norm of single channels takes away their means, and what is generated then keeps the mean of the noise."""

    def moved(norm_groups: int) -> float:
        torch.manual_seed(0)
        sizes = replace(load_preset(preset).model.denoiser, norm_groups=norm_groups)
        network = LatentUnet(sizes, 4, (8, 16))
        for weight in network.out.parameters():
            torch.nn.init.normal_(weight)
        noisy = torch.randn(2, 4, 8, 16)
        with torch.no_grad():
            low, high = (network(noisy + shift, torch.full((2,), 500.0)).mean((2, 3)) for shift in (0.0, 0.5))
        return float((high - low).abs().mean())

    groups = load_preset(preset).model.denoiser.norm_groups
    assert moved(groups) > 5 * moved(32)
