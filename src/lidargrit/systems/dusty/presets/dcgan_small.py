"""The GAN beneath DUSty, without raydrop of its own, at the size of the preset dusty_small."""

from dataclasses import replace

from lidargrit.core.configuration import override
from lidargrit.systems.dusty.presets import dusty_small

PRESET = replace(
    override(dusty_small.PRESET, ["model.variant=baseline"]),
    title="DCGAN, small: DUSty's baseline, which reads far pixels as no return",
)
