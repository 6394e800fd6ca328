"""LidarGAN's variational autoencoder on KITTI odometry at its published size: 40x256, 10.8 M parameters.

``model.latent_dim`` of 256 and 512 are published, too: 17.0 M and 29.6 M parameters.
"""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Preset
from lidargrit.systems.lidarvae.system import LidarVaeConfig

_TRAIN_SCANS = 19_130  # of sequences 00 to 07, 09 and 10: one epoch; the authors trained on KITTI raw

PRESET = Preset(
    title="LiDAR-VAE on KITTI odometry: 40 rows without raydrop, latents of 128 numbers",
    generator="lidarvae",
    model=LidarVaeConfig(warmup_scans=200 * _TRAIN_SCANS),
    data=DataConfig(
        train=("kitti_odometry:data/kitti_odometry:train",), val=("kitti_odometry:data/kitti_odometry:val",)
    ),
    training={
        "autoencoder": FitConfig(
            scans=300 * _TRAIN_SCANS,
            batch_size=64,
            learning_rate=1e-4,
            betas=(0.9, 0.999),
            gradient_clip=0.0,
            average_over_scans=0,
            validate_every=_TRAIN_SCANS,
            checkpoint_every=_TRAIN_SCANS,
        )
    },
)
