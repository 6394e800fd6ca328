"""The ablation for two CPU cores, first row: as ablation_raydrop_small, without raydrop loss."""

from dataclasses import replace

from lidargrit.core.configuration import override
from lidargrit.systems.lidargrit.presets import ablation_raydrop_small

PRESET = replace(
    override(ablation_raydrop_small.PRESET, ["model.tokenizer.raydrop_loss=false"]),
    title="the ablation, small, row 1: without raydrop loss and geometric preservation",
)
