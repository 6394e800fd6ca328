"""The diffusion of lidm_small over the VQ-VAE of the recipe small: diffusion against an autoregressive transformer.

With ``--set tokenizer_from=RUN`` it takes the very tokenizer of a trained run of small, and the two systems differ in
nothing but what generates the codes. Of the variance of these 98 % lie in four of 64 axes: noise is added along them
alone, each in its own standard deviation.
"""

from dataclasses import replace

from lidargrit.systems.lidargrit.presets import small
from lidargrit.systems.lidm.presets import lidm_small

RECIPE = replace(
    lidm_small.RECIPE,
    title="LiDM's diffusion over LidarGRIT's VQ-VAE, small: 64x256, for two CPU cores and an hour or two",
    model=replace(lidm_small.RECIPE.model, tokenizer=small.RECIPE.model.tokenizer, scale_latents=False, latent_axes=4),
    training={**lidm_small.RECIPE.training, "tokenizer": small.RECIPE.training["tokenizer"]},
)
