"""R2Flow at a size that two CPU cores can train in minutes, on simulated or on your own scans."""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Preset
from lidargrit.systems.r2flow.hdit import HditConfig
from lidargrit.systems.r2flow.system import R2flowConfig

PRESET = Preset(
    title="R2Flow (1-RF), small: 64x256, for two CPU cores",
    generator="r2flow",
    model=R2flowConfig(
        hdit=HditConfig(channels=24, time_channels=64, depths=(2, 2, 2, 2), heads=(1, 2, 4, 8)),
        reflectance=False,  # most other presets of this size learn the range alone
    ),
    data=DataConfig(train=("simulated:2000:train",), val=("simulated:32:val",)),
    training={
        "flow": FitConfig(
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
