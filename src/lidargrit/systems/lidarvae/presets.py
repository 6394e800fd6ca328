"""Presets of LidarGAN's variational autoencoder, at its published size and a small one."""

from dataclasses import replace

from lidargrit.generation.presets import GAN_MINUTES, KITTI_ODOMETRY, KITTI_ODOMETRY_EPOCH, STREETS, preset
from lidargrit.generation.settings import TrainingConfig
from lidargrit.systems.lidarvae.system import LidarVaeConfig

TO_COMPARE_WITH = {
    "lidarvae_small": preset(
        "LiDAR-VAE, small: 40 of 64 rows without raydrop, for two CPU cores and an hour",
        STREETS,
        LidarVaeConfig(latent_dim=64, channels=32, warmup_scans=20_000),
        autoencoder=replace(
            GAN_MINUTES,
            learning_rate=2e-4,  # 1e-3 from the first step on makes the log-variance overflow
            schedule="cosine",
            warmup_scans=2000,
            betas=(0.9, 0.999),
            average_over_scans=1000,
        ),
    ),
    # ``model.latent_dim`` of 256 and 512 are published, too: 17.0 M and 29.6 M parameters in place of 10.8 M.
    "lidarvae_kitti_odometry": preset(
        "LiDAR-VAE on KITTI odometry: 40 rows without raydrop, latents of 128 numbers",
        KITTI_ODOMETRY,
        LidarVaeConfig(warmup_scans=200 * KITTI_ODOMETRY_EPOCH),
        autoencoder=TrainingConfig(
            300 * KITTI_ODOMETRY_EPOCH,  # the authors trained on KITTI raw
            64,
            1e-4,
            betas=(0.9, 0.999),
            gradient_clip=0.0,
            average_over_scans=0,
            validate_every=KITTI_ODOMETRY_EPOCH,
            checkpoint_every=KITTI_ODOMETRY_EPOCH,
        ),
    ),
}
