"""LidarGAN on KITTI odometry at its published size: 40x256, 3.9 M + 2.2 M parameters.

The published optimiser is RMSprop. Adam without its first moment differs from it by the correction of the first steps.
"""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Preset
from lidargrit.systems.lidargan.system import LidarGanConfig

_TRAIN_SCANS = 19_130  # of sequences 00 to 07, 09 and 10: one epoch; the authors trained on KITTI raw

PRESET = Preset(
    title="LidarGAN on KITTI odometry: 40 rows without raydrop (model.loss=plain for its other loss)",
    generator="lidargan",
    model=LidarGanConfig(),
    data=DataConfig(
        train=("kitti_odometry:data/kitti_odometry:train",), val=("kitti_odometry:data/kitti_odometry:val",)
    ),
    training={
        "adversarial": FitConfig(
            scans=1000 * _TRAIN_SCANS,
            batch_size=32,
            learning_rate=1e-4,
            betas=(0.0, 0.99),
            gradient_clip=0.0,
            average_over_scans=0,
            validate_every=100_000,
            checkpoint_every=100_000,
        )
    },
    published="SWD 82.29e-2, min. matching distance 6.70e-3, JSD 15.98e-2, FPD 700 (LidarGRIT's paper, table 2)",
)
