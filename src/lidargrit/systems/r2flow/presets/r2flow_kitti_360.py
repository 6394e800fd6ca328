"""R2Flow's KITTI-360 experiment: spherical projection to 64x1024, range and reflectance, 80.9 M parameters."""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Preset
from lidargrit.systems.r2flow.system import R2flowConfig

PRESET = Preset(
    title="R2Flow (1-RF) on KITTI-360 (set data.train and data.val to kitti_360:ROOT:SPLIT)",
    generator="r2flow",
    model=R2flowConfig(),
    data=DataConfig(
        train=("kitti_360:data/kitti_360:train_without_val",),
        val=("kitti_360:data/kitti_360:val",),
        sensor="hdl64e_kitti_360",
    ),
    training={
        "flow": FitConfig(
            scans=2_560_000,
            batch_size=8,
            learning_rate=1e-4,
            schedule="cosine",
            warmup_scans=80_000,
            betas=(0.9, 0.99),
            gradient_clip=1.0,
            average_over_scans=11_000,  # half-life of a decay of 0.995 every 10 steps of 8 scans
            validate_every=50_000,
            checkpoint_every=10_000,
        ),
    },
)
