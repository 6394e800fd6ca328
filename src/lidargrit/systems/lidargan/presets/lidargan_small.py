"""LidarGAN at a size that two CPU cores can train in minutes, on simulated or on your own scans."""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Preset
from lidargrit.systems.lidargan.system import LidarGanConfig

PRESET = Preset(
    title="LidarGAN, small: 40 of 64 rows without raydrop, for two CPU cores and an hour",
    generator="lidargan",
    model=LidarGanConfig(channels=32),
    data=DataConfig(train=("simulated:2000:train",), val=("simulated:32:val",)),
    training={
        "adversarial": FitConfig(
            scans=60_000,
            batch_size=16,
            learning_rate=1e-4,
            betas=(0.0, 0.99),
            gradient_clip=0.0,
            augmentations=("flip",),
            any_columns=True,
            average_over_scans=0,  # batch norms know the statistics of the learned weights, not those of averaged ones
            validate_every=4000,
            checkpoint_every=4000,
        )
    },
)
