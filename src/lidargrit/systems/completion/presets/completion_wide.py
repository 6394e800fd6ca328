"""A network that completes scans of 64x1024, trained further from that of ``pretrained``."""

from dataclasses import replace

from lidargrit.systems.completion.presets import compact_completion

RECIPE = replace(
    compact_completion.RECIPE,
    title="a network that completes scans: 64x1024, for one CPU core and half an hour",
    data=replace(
        compact_completion.RECIPE.data,
        train=("simulated:1000:train",),
        val=("simulated:24:val",),
        columns=2048,
        column_stride=2,
    ),
    training={
        "completion": replace(
            compact_completion.RECIPE.training["completion"],
            scans=2500,
            batch_size=2,
            learning_rate=8e-4,
            warmup_scans=100,
            average_over_scans=150,
            validate_every=500,
            validation_scans=12,
            checkpoint_every=250,
        )
    },
    stages_from="pretrained/completion",
    fine_tune=("completion",),
)
