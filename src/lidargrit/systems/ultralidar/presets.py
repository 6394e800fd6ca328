"""Presets of UltraLiDAR: as its unofficial program has it for KITTI-360, and small."""

from dataclasses import replace

from lidargrit.generation.presets import KITTI_360, KITTI_360_EPOCH, MINUTES, STREETS, preset
from lidargrit.generation.settings import TrainingConfig
from lidargrit.systems.ultralidar.swin import SwinConfig
from lidargrit.systems.ultralidar.system import UltraLidarConfig
from lidargrit.systems.ultralidar.voxel_autoencoder import VoxelAutoencoderConfig
from lidargrit.systems.ultralidar.voxels import VoxelGrid

_SMALL = replace(MINUTES, scans=12_000, betas=(0.9, 0.95), weight_decay=0.01, gradient_clip=5.0)
_KITTI_360 = TrainingConfig(
    scans=80 * KITTI_360_EPOCH,
    batch_size=16,
    learning_rate=8e-4,
    schedule="cosine",
    warmup_scans=500 * 16,
    weight_decay=0.01,
    gradient_clip=5.0,
    average_over_scans=0,
    augmentations=("flip",),
    validate_every=KITTI_360_EPOCH,
    checkpoint_every=10_000,
)

PRESETS = {
    "ultralidar_small": preset(  # 20x256x256 voxels, 1.9 M parameters
        "UltraLiDAR, small: cells of 0.39 m, 1,024 tokens, for two CPU cores",
        STREETS,
        UltraLidarConfig(
            VoxelAutoencoderConfig(
                VoxelGrid(cell_m=(0.390625, 0.390625, 0.3), cells=(256, 256, 20)),
                blocks=SwinConfig(width=96, heads=4, blocks=4),
                num_codes=256,
                code_dim=64,
            ),
            SwinConfig(width=96, heads=4, blocks=6),
        ),
        autoencoder=_SMALL,
        prior=_SMALL,
    ),
    # 40x640x640 voxels, 158.3 M parameters. The program learns from the points themselves, here voxels hold the returns
    # of the images that all systems learn from. It mirrors voxels along both axes in training, and mirrors its samples
    # back for its scores; here only left and right are mirrored, so that scans face forward (``model.flips=true`` does
    # as the program).
    "ultralidar_kitti_360": preset(
        "UltraLiDAR on KITTI-360 (set data.train and data.val to kitti_360:ROOT:SPLIT)",
        KITTI_360,
        UltraLidarConfig(),
        published="LidarGRIT's table 1: BEV MMD 2.23e-4, BEV JSD 10.52e-2, neither SWD nor FPD (5,000 test scans)",
        autoencoder=_KITTI_360,
        prior=replace(_KITTI_360, scans=200 * KITTI_360_EPOCH, gradient_clip=15.0),
    ),
}
