"""Presets of the network that completes scans."""

from dataclasses import replace

from lidargrit.generation.presets import LATER_STAGE, WIDE_STREETS, preset
from lidargrit.systems.completion_only.completion_network import CompletionNetworkConfig
from lidargrit.systems.completion_only.system import CompletionOnlyConfig

COMPLETION = replace(
    LATER_STAGE,
    scans=22_000,
    batch_size=4,
    learning_rate=1.5e-3,
    augmentations=("flip",),
    average_over_scans=600,
    validate_every=2000,
)
"""Training of the network that ``pretrained`` has."""

PRESETS = {
    "completion_wide": preset(
        "a network that completes scans: 64x1024, for one CPU core and half an hour",
        WIDE_STREETS,
        CompletionOnlyConfig(CompletionNetworkConfig()),
        stages_from="pretrained",
        fine_tune=("completion",),
        completion=replace(
            COMPLETION,
            scans=2500,
            batch_size=2,
            learning_rate=8e-4,
            warmup_scans=100,
            average_over_scans=150,
            validate_every=500,
            validation_scans=12,
            checkpoint_every=250,
        ),
    )
}
