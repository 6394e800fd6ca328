"""Presets of DUSty: DUSty-I, DUSty-II and the plain DCGAN beneath them."""

from dataclasses import replace

from lidargrit.generation.presets import GAN_MINUTES, KITTI_ODOMETRY, STREETS, preset, variant
from lidargrit.generation.settings import TrainingConfig
from lidargrit.systems.dusty.system import DustyConfig

_SMALL = preset(
    "DUSty-I, small: 64x256, for two CPU cores and minutes",
    STREETS,
    DustyConfig(
        latent_dim=128,
        channels=16,
        max_channels=128,
        penalty_weight=0.1,  # after 8,000 scans the samples are as good as with the published 1 after 16,000
        augmentations=("translation", "cutout"),  # in so short a time no scan is learned by heart
    ),
    adversarial=replace(GAN_MINUTES, batch_size=8, learning_rate=4e-3, precision="auto", average_over_scans=1000),
)

PRESETS = {
    "dusty_small": _SMALL,
    "dusty_small_2": variant(
        "DUSty-II, small: 64x256, for two CPU cores and minutes", _SMALL, {"model.variant": "dusty_2"}
    ),
    "dusty_kitti_odometry": preset(  # 19.5 M + 2.8 M parameters
        "DUSty-I on KITTI odometry (model.variant=dusty_2 for DUSty-II, baseline for its plain DCGAN)",
        KITTI_ODOMETRY,
        DustyConfig(penalty_every=1),
        published="SWD 52.81e-2, min. matching distance 2.07e-3, JSD 5.10e-2, FPD 389 (LidarGRIT's paper, table 2)",
        adversarial=TrainingConfig(
            25_000_000,
            32,
            2e-3,
            betas=(0.0, 0.99),
            gradient_clip=0.0,
            precision="auto",
            average_over_scans=10_000,
            validate_every=100_000,
            checkpoint_every=100_000,
        ),
    ),
}
TO_COMPARE_WITH = {
    "dusty_small_dcgan": variant(
        "DCGAN, small: DUSty's baseline, which reads far pixels as no return", _SMALL, {"model.variant": "baseline"}
    )
}
