"""LiDARGen at a size that two CPU cores can train in an hour, on simulated or on your own scans.

It is sampled with 58 levels of 3 steps, 175 passes of the network; ``levels=232 steps_each=5`` are the paper's 1,161.
Steps of the published size would leave nothing but noise at so few levels, so they are larger by default.
The largest noise, 50 as published, is above the largest distance between two of 24 simulated scans of this size, 41.6,
as Song and Ermon (2020) want it.
"""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Preset
from lidargrit.systems.lidargen.system import LidarGenConfig

PRESET = Preset(
    title="LiDARGen, small: 64x256, 58 levels of 3 steps, for two CPU cores and an hour",
    generator="lidargen",
    model=LidarGenConfig(
        channels=16,
        reflectance=False,  # the other small presets learn range alone
        levels=58,
        steps_each=3,
    ),
    data=DataConfig(train=("simulated:2000:train",), val=("simulated:32:val",)),
    training={
        "score": FitConfig(
            scans=10_000,
            batch_size=4,
            learning_rate=1e-3,
            schedule="cosine",
            warmup_scans=400,
            betas=(0.9, 0.999),
            precision="fp32",  # 16 bits round away the noise of the last levels
            augmentations=("flip",),
            any_columns=True,
            average_over_scans=500,
            validate_every=1000,
            checkpoint_every=500,
        ),
    },
)
