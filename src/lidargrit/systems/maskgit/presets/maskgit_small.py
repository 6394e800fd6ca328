"""MaskGIT at the size of the preset small, the same VQ-VAE and blocks: tokens in 16 passes, not one by one."""

from dataclasses import replace

from lidargrit.systems.lidargrit.presets import small
from lidargrit.systems.maskgit.system import MaskGitConfig

PRESET = replace(
    small.PRESET,
    title="MaskGIT, small: small's networks, the second filling in tokens in few passes",
    generator="maskgit",
    model=MaskGitConfig(small.PRESET.model.tokenizer, small.PRESET.model.transformer),
)
