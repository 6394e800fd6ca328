"""Presets of R2DM, at its published size and a small one."""

from dataclasses import replace

from lidargrit.generation.presets import DIFFUSION_ON_KITTI_360, KITTI_360, MINUTES, NUSCENES, STREETS, preset
from lidargrit.systems.r2dm.system import R2dmConfig
from lidargrit.systems.r2dm.unet import UnetConfig

PRESETS = {
    "r2dm_small": preset(
        "R2DM, small: 64x256, for two CPU cores and some minutes",
        STREETS,
        R2dmConfig(
            UnetConfig(channels=16, channel_multipliers=(1, 2, 4, 8), residual_blocks=(1, 1, 1, 1)),
            reflectance=False,  # the other small presets learn the range alone; the authors find it sharper, too
        ),
        diffusion=MINUTES,
    ),
    "r2dm_kitti_360": preset(  # 31.1 M parameters
        "R2DM on KITTI-360 (set data.train and data.val to kitti_360:ROOT:SPLIT)",
        KITTI_360,
        R2dmConfig(),
        published="LidarGRIT's table 1: SWD 20.82e-2, BEV MMD 4.00e-4, BEV JSD 4.55e-2, FPD 10.84 (5,000 test scans)",
        diffusion=replace(DIFFUSION_ON_KITTI_360, scans=2_400_000, precision="auto"),  # the reference's is float16
    ),
    "r2dm_nuscenes": preset(
        "R2DM on nuScenes, 32x1024, a row for each laser (set data.train and data.val to nuscenes:ROOT:SPLIT)",
        NUSCENES,
        R2dmConfig(),
        diffusion=replace(DIFFUSION_ON_KITTI_360, scans=2_400_000, precision="auto"),
    ),
}
