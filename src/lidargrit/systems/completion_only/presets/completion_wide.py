"""A network that completes scans of 64x1024, trained further from that of ``pretrained``."""

from dataclasses import replace

from lidargrit.generation.settings import Preset
from lidargrit.systems.completion_only.system import CompletionOnlyConfig
from lidargrit.systems.lidargrit.presets import compact_completion
from lidargrit.systems.multiscale.presets import multiscale_wide

PRESET = Preset(
    title="a network that completes scans: 64x1024, for one CPU core and half an hour",
    generator="completion_only",
    model=CompletionOnlyConfig(compact_completion.PRESET.model.completion),
    data=multiscale_wide.PRESET.data,
    training={
        "completion": replace(
            compact_completion.PRESET.training["completion"],
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
    stages_from="pretrained",
    fine_tune=("completion",),
)
