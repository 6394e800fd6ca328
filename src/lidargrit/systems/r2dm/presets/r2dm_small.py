"""R2DM at a size that two CPU cores can train in minutes, on simulated or on your own scans."""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Preset
from lidargrit.systems.r2dm.system import R2dmConfig
from lidargrit.systems.r2dm.unet import UnetConfig

PRESET = Preset(
    title="R2DM, small: 64x256, for two CPU cores and some minutes",
    generator="r2dm",
    model=R2dmConfig(
        unet=UnetConfig(channels=16, channel_multipliers=(1, 2, 4, 8), residual_blocks=(1, 1, 1, 1)),
        reflectance=False,  # the other small presets learn the range alone; the authors find it sharper, too
    ),
    data=DataConfig(train=("simulated:2000:train",), val=("simulated:32:val",)),
    training={
        "diffusion": FitConfig(
            scans=20_000,
            batch_size=4,
            learning_rate=1e-3,
            schedule="cosine",
            warmup_scans=400,
            betas=(0.9, 0.99),
            precision="auto",
            augmentations=("flip",),
            any_columns=True,
            average_over_scans=500,
            validate_every=1000,
            checkpoint_every=500,
        ),
    },
)
