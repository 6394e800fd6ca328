"""DUSty-II, which also keeps or drops a scan as a whole, at the size of the preset dusty_small."""

from dataclasses import replace

from lidargrit.core.configuration import override
from lidargrit.systems.dusty.presets import dusty_small

PRESET = replace(
    override(dusty_small.PRESET, ["model.variant=dusty_2"]),
    title="DUSty-II, small: 64x256, for two CPU cores and minutes",
)
