"""MaskGIT for a few minutes, as the preset demo; a demo's tokenizer can be taken by ``tokenizer_from``."""

from dataclasses import replace

from lidargrit.systems.lidargrit.presets import demo
from lidargrit.systems.maskgit.presets import maskgit_small

PRESET = replace(
    maskgit_small.PRESET,
    title="MaskGIT, demo: the small model for a few minutes",
    data=demo.PRESET.data,
    training=demo.PRESET.training,
)
