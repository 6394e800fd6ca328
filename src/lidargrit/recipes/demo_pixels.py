"""The recipe ``demo`` with a pixel decoder, for ``lidargrit demo``."""

from dataclasses import replace

from lidargrit.recipes import compact_pixels, demo

RECIPE = replace(
    demo.RECIPE,
    title="LidarGRIT with a pixel decoder, demo: the small model for a few minutes",
    model=replace(demo.RECIPE.model, pixels=compact_pixels.RECIPE.model.pixels),
    training={
        **demo.RECIPE.training,
        "pixels": replace(
            compact_pixels.RECIPE.training["pixels"],
            scans=1000,
            warmup_scans=100,
            average_over_scans=100,
            validate_every=500,
            checkpoint_every=200,
        ),
    },
)
