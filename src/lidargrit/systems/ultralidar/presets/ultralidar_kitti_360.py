"""UltraLiDAR's KITTI-360 experiment, as its unofficial program has it: 40x640x640 voxels, 158.3 M parameters.

The program learns from the points themselves, here voxels hold the returns of the images that all systems learn from.
It mirrors voxels along both axes in training, and mirrors its samples back for its scores; here only left and right are
mirrored, so that scans face forward (``model.flips=true`` does as the program).
"""

from dataclasses import replace

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Preset
from lidargrit.systems.ultralidar.system import UltraLidarConfig

_TRAIN_SCANS = 50_000  # roughly one epoch of the training drives
_FIT = FitConfig(
    scans=80 * _TRAIN_SCANS,
    batch_size=16,
    learning_rate=8e-4,
    schedule="cosine",
    warmup_scans=500 * 16,
    weight_decay=0.01,
    gradient_clip=5.0,
    average_over_scans=0,
    augmentations=("flip",),
    validate_every=_TRAIN_SCANS,
    checkpoint_every=10_000,
)

PRESET = Preset(
    title="UltraLiDAR on KITTI-360 (set data.train and data.val to kitti_360:ROOT:SPLIT)",
    generator="ultralidar",
    model=UltraLidarConfig(),
    data=DataConfig(
        train=("kitti_360:data/kitti_360:train_without_val",),
        val=("kitti_360:data/kitti_360:val",),
        sensor="hdl64e_kitti_360",
    ),
    training={"autoencoder": _FIT, "prior": replace(_FIT, scans=200 * _TRAIN_SCANS, gradient_clip=15.0)},
    published="LidarGRIT's table 1: BEV MMD 2.23e-4, BEV JSD 10.52e-2, neither SWD nor FPD (5,000 test scans)",
)
