"""``pretrained`` with a network that completes scans, fed by triangulation."""

from dataclasses import replace

from lidargrit.generation.settings import FitConfig
from lidargrit.systems.completion_only.completion_network import CompletionNetworkConfig
from lidargrit.systems.lidargrit.presets import compact_pixels

PRESET = replace(
    compact_pixels.PRESET,
    title="LidarGRIT with a network that completes scans: 64x256, for one CPU core and an hour",
    model=replace(compact_pixels.PRESET.model, completion=CompletionNetworkConfig()),
    data=replace(compact_pixels.PRESET.data, train=("simulated:4352:train",)),
    training={
        **compact_pixels.PRESET.training,
        "completion": FitConfig(
            scans=22_000,
            batch_size=4,
            learning_rate=1.5e-3,
            schedule="cosine",
            warmup_scans=200,
            betas=(0.9, 0.98),
            precision="auto",
            any_columns=True,
            augmentations=("flip",),
            average_over_scans=600,
            validate_every=2000,
            checkpoint_every=500,
        ),
    },
    stages_from="pretrained",
    train_anew=("completion",),
)
