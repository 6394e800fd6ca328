"""DUSty-I at a size that two CPU cores can train in minutes, on simulated or on your own scans."""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Preset
from lidargrit.systems.dusty.system import DustyConfig

PRESET = Preset(
    title="DUSty-I, small: 64x256, for two CPU cores and minutes",
    generator="dusty",
    model=DustyConfig(
        latent_dim=128,
        channels=16,
        max_channels=128,
        penalty_weight=0.1,  # after 8,000 scans the samples are as good as with the published 1 after 16,000
        augmentations=("translation", "cutout"),  # in so short a time no scan is learned by heart
    ),
    data=DataConfig(train=("simulated:2000:train",), val=("simulated:32:val",)),
    training={
        "adversarial": FitConfig(
            scans=60_000,
            batch_size=8,
            learning_rate=4e-3,
            betas=(0.0, 0.99),
            gradient_clip=0.0,
            precision="auto",
            augmentations=("flip",),
            any_columns=True,
            average_over_scans=1000,
            validate_every=4000,
            checkpoint_every=4000,
        )
    },
)
