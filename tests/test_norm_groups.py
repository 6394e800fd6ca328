"""Groups of the norms of small networks, which must not take away what an image has in the mean."""

from dataclasses import replace

import pytest
import torch

from lidargrit.core.errors import ConfigError
from lidargrit.generation.presets import load_preset
from lidargrit.generation.tokenizers import make_tokenizer
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


def test_all_norms_of_a_tokenizer_have_as_many_groups_as_its_setting_says():
    loaded = load_preset("lidm_small")
    plain, coarser = (
        make_tokenizer(replace(loaded.model.tokenizer, norm_groups=groups), loaded.data.load_sensor())
        for groups in (32, 8)
    )
    norms = [module for module in coarser.modules() if isinstance(module, torch.nn.GroupNorm)]
    assert {norm.num_groups for norm in norms} == {8}
    assert len(norms) > 10
    shapes = [{name: weight.shape for name, weight in each.state_dict().items()} for each in (plain, coarser)]
    assert shapes[0] == shapes[1]
    for groups in (0, 24):
        with pytest.raises(ConfigError, match=f"{groups}"):
            replace(loaded.model.tokenizer, norm_groups=groups)
