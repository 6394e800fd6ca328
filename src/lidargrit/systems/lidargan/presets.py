"""Presets of LidarGAN, at its published size and a small one."""

from dataclasses import replace

from lidargrit.generation.presets import GAN_MINUTES, KITTI_ODOMETRY, KITTI_ODOMETRY_EPOCH, STREETS, preset
from lidargrit.systems.lidargan.system import LidarGanConfig

PRESETS = {
    "lidargan_small": preset(
        "LidarGAN, small: 40 of 64 rows without raydrop, for two CPU cores and an hour",
        STREETS,
        LidarGanConfig(channels=32),
        # Batch norms know the statistics of the learned weights, not those of averaged ones.
        adversarial=GAN_MINUTES,
    ),
    "lidargan_kitti_odometry": preset(  # 3.9 M + 2.2 M parameters
        "LidarGAN on KITTI odometry: 40 rows without raydrop (model.loss=plain for its other loss)",
        KITTI_ODOMETRY,
        LidarGanConfig(),
        published="SWD 82.29e-2, min. matching distance 6.70e-3, JSD 15.98e-2, FPD 700 (LidarGRIT's paper, table 2)",
        # The authors trained on KITTI raw, by RMSprop; Adam without its first moment differs by its first steps alone.
        adversarial=replace(
            GAN_MINUTES,
            scans=1000 * KITTI_ODOMETRY_EPOCH,
            batch_size=32,
            augmentations=(),
            any_columns=False,
            validate_every=100_000,
            checkpoint_every=100_000,
        ),
    ),
}
