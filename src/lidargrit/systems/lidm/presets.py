"""Presets of LiDM over its own first stage, and of its diffusion over LidarGRIT's VQ-VAE.

The small ones have, unlike the published, a mask channel, restart codes that are not used, and scale their latents.
"""

from dataclasses import replace

from lidargrit.generation import presets as shared
from lidargrit.generation.presets import preset, variant
from lidargrit.generation.settings import TrainingConfig
from lidargrit.generation.tokenizers.curve_vqvae import CurveVqvaeConfig
from lidargrit.systems.lidm.latent_unet import LatentUnetConfig
from lidargrit.systems.lidm.system import LidmConfig

_SMALL = preset(
    "LiDM, small: 64x256, its own first stage, for two CPU cores and an hour",
    shared.STREETS,
    LidmConfig(
        CurveVqvaeConfig(
            channels=32,
            channel_multipliers=(1, 1, 2, 2),
            residual_blocks=1,
            num_codes=1024,
            range_scale=7.0,  # log2(1 + 127 m); the sensor sees 120 m
            mask_head=True,
            restart_dead_codes=True,
        ),
        LatentUnetConfig(32, (1, 2, 3), 1, attention_levels=(1, 2), head_channels=16, norm_groups=8),
        scale_latents=True,
    ),
    tokenizer=replace(shared.SMALL_STAGES["tokenizer"], scans=10_000, learning_rate=1e-3, betas=(0.5, 0.9)),
    denoiser=replace(
        shared.MINUTES,
        scans=60_000,
        batch_size=8,
        warmup_scans=800,
        betas=(0.9, 0.999),
        any_columns=False,  # so that each latent is computed once and kept
        average_over_scans=2000,
        validate_every=3000,
        checkpoint_every=2000,
    ),
)
# The authors give no number of scans for the diffusion model; 2,560,000 is R2DM's. Their program also mirrors scans
# from front to back, and turns those of the first stage by up to 45 degrees: here they are mirrored from left to right
# alone, so that samples have a front.
_KITTI_360 = preset(  # 15.1 M and 257.8 M parameters
    "LiDM on KITTI-360 (set data.train and data.val to kitti_360:ROOT:SPLIT)",
    shared.KITTI_360,
    LidmConfig(),
    published="LiDM's README: FRID 135.8, FSVD 37.9, FPVD 28.7, JSD 0.211, MMD 3.87e-4 (2,000 samples, 50 steps)",
    tokenizer=TrainingConfig(
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
    denoiser=TrainingConfig(
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
)

PRESETS = {"lidm_small": _SMALL, "lidm_kitti_360": _KITTI_360}
# With ``--set training.tokenizer.start=frozen:RUN`` these take the very tokenizer of a run of lidargrit_small or
# lidargrit_kitti_360, and the two systems differ in nothing but what generates the codes. Of the variance of the small
# one's codes 98 % lie in four of 64 axes: noise is added along them alone, each in its own standard deviation.
TO_COMPARE_WITH = {
    "lidm_small_shared": variant(
        "LiDM's diffusion over LidarGRIT's VQ-VAE, small: 64x256, for two CPU cores and an hour or two",
        _SMALL,
        {
            "model.tokenizer": shared.SMALL_VQVAE,
            "model.scale_latents": False,
            "model.latent_axes": 4,
            "training.tokenizer": shared.SMALL_STAGES["tokenizer"],
        },
    ),
    "lidm_kitti_360_shared": variant(
        "LiDM's diffusion over LidarGRIT's VQ-VAE, KITTI-360 (set data.train and data.val to kitti_360:ROOT:SPLIT)",
        _KITTI_360,
        {
            "model.tokenizer": shared.KITTI_360_VQVAE,
            "model.latent_axes": 8,
            "training.tokenizer": shared.KITTI_360_TOKENIZER,
            "published": "",  # no paper has compared them
        },
    ),
}
