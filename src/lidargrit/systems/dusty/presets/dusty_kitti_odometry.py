"""DUSty v1 as published for KITTI odometry: unfolding to 64x256, 19.5 M + 2.8 M parameters."""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Preset
from lidargrit.systems.dusty.system import DustyConfig

PRESET = Preset(
    title="DUSty-I on KITTI odometry (model.variant=dusty_2 for DUSty-II, baseline for its plain DCGAN)",
    generator="dusty",
    model=DustyConfig(penalty_every=1),
    data=DataConfig(
        train=("kitti_odometry:data/kitti_odometry:train",), val=("kitti_odometry:data/kitti_odometry:val",)
    ),
    training={
        "adversarial": FitConfig(
            scans=25_000_000,
            batch_size=32,
            learning_rate=2e-3,
            betas=(0.0, 0.99),
            gradient_clip=0.0,
            precision="auto",
            average_over_scans=10_000,
            validate_every=100_000,
            checkpoint_every=100_000,
        )
    },
    published="SWD 52.81e-2, min. matching distance 2.07e-3, JSD 5.10e-2, FPD 389 (LidarGRIT's paper, table 2)",
)
