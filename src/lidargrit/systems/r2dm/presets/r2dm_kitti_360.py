"""R2DM's KITTI-360 experiment: spherical projection to 64x1024, range and reflectance, 31.1 M parameters."""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Preset
from lidargrit.systems.r2dm.system import R2dmConfig

PRESET = Preset(
    title="R2DM on KITTI-360 (set data.train and data.val to kitti_360:ROOT:SPLIT)",
    generator="r2dm",
    model=R2dmConfig(),
    data=DataConfig(
        train=("kitti_360:data/kitti_360:train_without_val",),
        val=("kitti_360:data/kitti_360:val",),
        sensor="hdl64e_kitti_360",
    ),
    training={
        "diffusion": FitConfig(
            scans=300_000 * 8,
            batch_size=8,
            learning_rate=1e-4,
            schedule="cosine",
            warmup_scans=10_000 * 8,
            betas=(0.9, 0.99),
            gradient_clip=1.0,
            average_over_scans=11_000,  # half-life of a decay of 0.995 every 10 steps of 8 scans
            precision="auto",  # the reference's is float16
            validate_every=50_000,
            checkpoint_every=10_000,
        ),
    },
    published="LidarGRIT's table 1: SWD 20.82e-2, BEV MMD 4.00e-4, BEV JSD 4.55e-2, FPD 10.84 (5,000 test scans)",
)
