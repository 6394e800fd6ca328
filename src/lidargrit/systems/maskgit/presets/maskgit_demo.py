"""MaskGIT for a few minutes, as the recipe demo; a demo's tokenizer can be taken by ``tokenizer_from``."""

from dataclasses import replace

from lidargrit.systems.lidargrit.presets import demo
from lidargrit.systems.maskgit.presets import maskgit_small

RECIPE = replace(
    maskgit_small.RECIPE,
    title="MaskGIT, demo: the small model for a few minutes",
    data=demo.RECIPE.data,
    training=demo.RECIPE.training,
)
