"""LiDARGen's KITTI-360 experiment: spherical projection to 64x1024, range and reflectance, 29.7 M parameters."""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Preset
from lidargrit.systems.lidargen.system import LidarGenConfig

PRESET = Preset(
    title="LiDARGen on KITTI-360 (set data.train and data.val to kitti_360:ROOT:SPLIT)",
    generator="lidargen",
    model=LidarGenConfig(),
    data=DataConfig(
        train=("kitti_360:data/kitti_360:train_without_val",),
        val=("kitti_360:data/kitti_360:val",),
        sensor="hdl64e_kitti_360",
    ),
    training={
        "score": FitConfig(
            scans=100_000 * 24,  # the authors score the checkpoint of step 100,000; their configuration goes on
            batch_size=24,
            learning_rate=1e-4,
            betas=(0.9, 0.999),
            gradient_clip=0.0,
            average_over_scans=16_600,  # half-life of a decay of 0.999 every step of 24 scans
            precision="fp32",  # 16 bits round away the noise of the last levels
            validate_every=50_000,
            checkpoint_every=10_000,
        ),
    },
    published="LidarGRIT's table 1: SWD 33.93e-2, BEV MMD 2.19e-4, BEV JSD 5.70e-2, FPD 43.27 (5,000 test scans)",
)
