"""The ablation for two CPU cores, second row: as ablation_both_small, without geometric preservation."""

from dataclasses import replace

from lidargrit.recipes import ablation_both_small

_BOTH = ablation_both_small.RECIPE

RECIPE = replace(
    _BOTH,
    title="the ablation, small, row 2: with raydrop loss, without geometric preservation",
    training={**_BOTH.training, "tokenizer": replace(_BOTH.training["tokenizer"], augmentations=())},
)
