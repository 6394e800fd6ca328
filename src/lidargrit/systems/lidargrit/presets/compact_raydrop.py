"""``pretrained`` with a network of raydrop, trained on simulated streets of which all surfaces are known."""

from dataclasses import replace

from lidargrit.generation.settings import FitConfig
from lidargrit.systems.lidargrit.presets import compact_pixels
from lidargrit.systems.raydrop.raydrop_network import RaydropConfig

PRESET = replace(
    compact_pixels.PRESET,
    title="LidarGRIT with a network of raydrop for clean scans: 64x256, for one CPU core and ten minutes",
    model=replace(compact_pixels.PRESET.model, raydrop=RaydropConfig()),
    data=replace(
        compact_pixels.PRESET.data, train=("simulated_surfaces:512:train",), val=("simulated_surfaces:64:val",)
    ),
    training={
        **compact_pixels.PRESET.training,
        "raydrop": FitConfig(
            scans=4000,
            batch_size=4,
            learning_rate=2e-3,
            schedule="cosine",
            warmup_scans=200,
            betas=(0.9, 0.98),
            precision="auto",
            any_columns=True,
            augmentations=("flip",),
            average_over_scans=300,
            validate_every=1000,
            validation_scans=32,
            checkpoint_every=500,
        ),
    },
    stages_from="pretrained",
    train_anew=("raydrop",),
)
