"""LiDM at a size that two CPU cores can train in an hour, on simulated or on your own scans.

Unlike the published models it has a mask channel, restarts codes that are not used, and scales its latents.
"""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Preset
from lidargrit.generation.tokenizers.curve_vqvae import CurveVqvaeConfig
from lidargrit.systems.lidm.latent_unet import LatentUnetConfig
from lidargrit.systems.lidm.system import LidmConfig

PRESET = Preset(
    title="LiDM, small: 64x256, its own first stage, for two CPU cores and an hour",
    generator="lidm",
    model=LidmConfig(
        tokenizer=CurveVqvaeConfig(
            channels=32,
            channel_multipliers=(1, 1, 2, 2),
            residual_blocks=1,
            num_codes=1024,
            range_scale=7.0,  # log2(1 + 127 m); the sensor sees 120 m
            mask_head=True,
            restart_dead_codes=True,
        ),
        denoiser=LatentUnetConfig(32, (1, 2, 3), 1, attention_levels=(1, 2), head_channels=16, norm_groups=8),
        scale_latents=True,
    ),
    data=DataConfig(train=("simulated:2000:train",), val=("simulated:32:val",)),
    training={
        "tokenizer": FitConfig(
            scans=10_000,
            batch_size=2,
            learning_rate=1e-3,
            schedule="cosine",
            warmup_scans=300,
            betas=(0.5, 0.9),
            precision="auto",
            augmentations=("flip", "roll"),
            any_columns=True,
            average_over_scans=300,
            validate_every=1000,
            checkpoint_every=500,
        ),
        "denoiser": FitConfig(
            scans=60_000,
            batch_size=8,
            learning_rate=1e-3,
            schedule="cosine",
            warmup_scans=800,
            betas=(0.9, 0.999),
            precision="auto",
            augmentations=("flip",),  # without other columns, so that each latent is computed once and kept
            average_over_scans=2000,
            validate_every=3000,
            checkpoint_every=2000,
        ),
    },
)
