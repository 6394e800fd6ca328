"""DUSty-I at a size that two CPU cores can train in minutes, on simulated or on your own scans."""

from lidargrit.generators.dusty import DustyConfig
from lidargrit.loading import DataConfig
from lidargrit.training import FitConfig, Recipe

RECIPE = Recipe(
    title="DUSty-I, small: 64x256, for two CPU cores and minutes",
    generator="dusty",
    model=DustyConfig(latent_dim=128, channels=16, max_channels=128),
    data=DataConfig(train=("simulated:2000:train",), val=("simulated:32:val",)),
    training={
        "adversarial": FitConfig(
            scans=60_000,
            batch_size=16,
            learning_rate=2e-3,
            betas=(0.0, 0.99),
            gradient_clip=0.0,
            precision="auto",
            augmentations=("flip",),
            any_columns=True,
            average_over_scans=2000,
            validate_every=4000,
            checkpoint_every=4000,
        )
    },
)
