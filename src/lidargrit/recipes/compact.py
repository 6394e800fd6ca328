"""LidarGRIT as it comes with the package: an image an eighth as high and wide in tokens, trained on the simulator."""

from dataclasses import replace

from lidargrit.recipes import small

_VQVAE, _TRANSFORMER = small.RECIPE.training["tokenizer"], small.RECIPE.training["transformer"]

RECIPE = replace(
    small.RECIPE,
    title="the model in the package: 64x256 in 256 tokens, for one CPU core and an hour",
    model=replace(
        small.RECIPE.model,
        # A quarter of the tokens of ``small`` for little of its detail: so the transformer learns, and writes, sooner.
        tokenizer=replace(small.RECIPE.model.tokenizer, channel_multipliers=(1, 1, 2, 4), num_codes=1024),
        transformer=replace(small.RECIPE.model.transformer, layers=5, width=256),
    ),
    training={
        "tokenizer": replace(_VQVAE, scans=8_000),
        "transformer": replace(_TRANSFORMER, scans=20_000),
    },
)
