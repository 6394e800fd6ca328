"""The whole story in minutes: the small model on a few hundred simulated scans, for ``lidargrit demo``."""

from dataclasses import replace

from lidargrit.recipes import small

RECIPE = replace(
    small.RECIPE,
    title="LidarGRIT, demo: the small model for a few minutes",
    data=replace(small.RECIPE.data, train=("simulated:300:train",), val=("simulated:16:val",)),
    training={
        "tokenizer": replace(small.RECIPE.training["tokenizer"], scans=2400, validate_every=800, checkpoint_every=400),
        "transformer": replace(
            small.RECIPE.training["transformer"], scans=4800, validate_every=1600, checkpoint_every=400
        ),
    },
)
