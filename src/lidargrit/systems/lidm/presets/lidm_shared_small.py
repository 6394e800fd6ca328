"""The diffusion of lidm_small over the VQ-VAE of the preset small: diffusion against an autoregressive transformer.

With ``--set tokenizer_from=RUN`` it takes the very tokenizer of a trained run of small, and the two systems differ in
nothing but what generates the codes. Of the variance of these 98 % lie in four of 64 axes: noise is added along them
alone, each in its own standard deviation.
"""

from dataclasses import replace

from lidargrit.systems.lidargrit.presets import small
from lidargrit.systems.lidm.presets import lidm_small

PRESET = replace(
    lidm_small.PRESET,
    title="LiDM's diffusion over LidarGRIT's VQ-VAE, small: 64x256, for two CPU cores and an hour or two",
    model=replace(lidm_small.PRESET.model, tokenizer=small.PRESET.model.tokenizer, scale_latents=False, latent_axes=4),
    training={**lidm_small.PRESET.training, "tokenizer": small.PRESET.training["tokenizer"]},
)
