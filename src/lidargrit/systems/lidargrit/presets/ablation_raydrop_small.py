"""The ablation for two CPU cores, second row: as ablation_both_small, without geometric preservation."""

from dataclasses import replace

from lidargrit.core.configuration import override
from lidargrit.systems.lidargrit.presets import ablation_both_small

PRESET = replace(
    override(ablation_both_small.PRESET, ["training.tokenizer.augmentations=[]"]),
    title="the ablation, small, row 2: with raydrop loss, without geometric preservation",
)
