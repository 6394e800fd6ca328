"""LidarGAN's autoencoder at a size that two CPU cores can train in minutes, on simulated or on your own scans."""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Preset
from lidargrit.systems.lidarvae.system import LidarVaeConfig

PRESET = Preset(
    title="LiDAR-VAE, small: 40 of 64 rows without raydrop, for two CPU cores and an hour",
    generator="lidarvae",
    model=LidarVaeConfig(latent_dim=64, channels=32, warmup_scans=20_000),
    data=DataConfig(train=("simulated:2000:train",), val=("simulated:32:val",)),
    training={
        "autoencoder": FitConfig(
            scans=60_000,
            batch_size=16,
            learning_rate=2e-4,  # 1e-3 from the first step on makes the log-variance overflow
            warmup_scans=2000,
            schedule="cosine",
            betas=(0.9, 0.999),
            gradient_clip=0.0,
            augmentations=("flip",),
            any_columns=True,
            average_over_scans=1000,
            validate_every=4000,
            checkpoint_every=4000,
        )
    },
)
