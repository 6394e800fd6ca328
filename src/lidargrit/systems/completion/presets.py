"""Presets of the network that completes scans."""

from dataclasses import replace

from lidargrit.generation.presets import ANY_SENSOR, LATER_STAGE, MORE_STREETS, WIDE_STREETS, preset
from lidargrit.systems.completion.network import CompletionNetworkConfig
from lidargrit.systems.completion.system import CompletionConfig

_COMPLETION = replace(
    LATER_STAGE,
    scans=22_000,
    batch_size=4,
    learning_rate=1.5e-3,
    augmentations=("flip",),
    average_over_scans=600,
    validate_every=2000,
)

PRESETS = {
    "completion_compact": preset(
        "a network that completes scans: 64x256, for one CPU core and an hour",
        MORE_STREETS,
        CompletionConfig(),
        completion=_COMPLETION,
    ),
    "completion_any": preset(
        "a network that completes scans of any spinning sensor: for one CPU core and half an hour",
        ANY_SENSOR,
        CompletionConfig(CompletionNetworkConfig(any_sensor=True)),
        completion=replace(
            _COMPLETION, scans=8000, learning_rate=8e-4, average_over_scans=300, start="pretrained/completion"
        ),
    ),
    "completion_wide": preset(
        "a network that completes scans: 64x1024, for one CPU core and half an hour",
        WIDE_STREETS,
        CompletionConfig(),
        completion=replace(
            _COMPLETION,
            scans=2500,
            batch_size=2,
            learning_rate=8e-4,
            warmup_scans=100,
            average_over_scans=150,
            validate_every=500,
            validation_scans=12,
            checkpoint_every=250,
            start="pretrained/completion",
        ),
    ),
}
