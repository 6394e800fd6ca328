"""The ablation for two CPU cores, first row: as ablation_raydrop_small, without raydrop loss."""

from dataclasses import replace

from lidargrit.recipes import ablation_raydrop_small

_WITH = ablation_raydrop_small.RECIPE

RECIPE = replace(
    _WITH,
    title="the ablation, small, row 1: without raydrop loss and geometric preservation",
    model=replace(_WITH.model, tokenizer=replace(_WITH.model.tokenizer, raydrop_loss=False)),
)
