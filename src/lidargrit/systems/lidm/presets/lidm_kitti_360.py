"""LiDM's KITTI-360 experiment: spherical projection to 64x1024, range to 56 m, 15.1 M and 257.8 M parameters.

The authors give no number of scans for the diffusion model; 2,560,000 is R2DM's. Their program also mirrors scans from
front to back, and turns those of the first stage by up to 45 degrees: here they are mirrored from left to right alone,
so that samples have a front.
"""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Preset
from lidargrit.systems.lidm.system import LidmConfig

PRESET = Preset(
    title="LiDM on KITTI-360 (set data.train and data.val to kitti_360:ROOT:SPLIT)",
    generator="lidm",
    model=LidmConfig(),
    data=DataConfig(
        train=("kitti_360:data/kitti_360:train_without_val",),
        val=("kitti_360:data/kitti_360:val",),
        sensor="hdl64e_kitti_360",
    ),
    training={
        "tokenizer": FitConfig(
            scans=320_000,  # 40,000 steps of 8 scans, as in the paper's ablations
            batch_size=8,
            accumulate=2,  # 4 scans at a time, as the authors' program
            learning_rate=4.5e-6 * 8,  # 4.5e-6 for each scan of a step
            betas=(0.5, 0.9),
            gradient_clip=0.0,
            average_over_scans=0,
            augmentations=("flip",),
            validate_every=10_000,
            checkpoint_every=4_000,
        ),
        "denoiser": FitConfig(
            scans=2_560_000,
            batch_size=16,
            learning_rate=1e-6 * 16,  # 1e-6 for each scan of a step
            betas=(0.9, 0.999),
            weight_decay=0.01,  # of linear layers alone, 5 % of the weights; the authors' reaches all of them
            gradient_clip=0.0,
            average_over_scans=110_000,  # half-life of a decay of 0.9999 every step of 16 scans
            augmentations=("flip",),
            validate_every=50_000,
            checkpoint_every=10_000,
        ),
    },
    published="LiDM's README: FRID 135.8, FSVD 37.9, FPVD 28.7, JSD 0.211, MMD 3.87e-4 (2,000 samples, 50 steps)",
)
