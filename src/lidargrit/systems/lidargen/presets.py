"""Presets of LiDARGen, at its published size and a small one."""

from dataclasses import replace

from lidargrit.generation.presets import KITTI_360, MINUTES, STREETS, preset
from lidargrit.generation.settings import TrainingConfig
from lidargrit.systems.lidargen.system import LidarGenConfig

PRESETS = {
    # 175 passes of the network; ``levels=232 steps_each=5`` are the paper's 1,161. Steps of the published size would
    # leave nothing but noise at so few levels, so they are larger by default. The largest noise, 50 as published, is
    # above the largest distance between two of 24 simulated scans of this size, 41.6, as Song and Ermon (2020) want it.
    "lidargen_small": preset(
        "LiDARGen, small: 64x256, 58 levels of 3 steps, for two CPU cores and an hour",
        STREETS,
        LidarGenConfig(channels=16, reflectance=False, levels=58, steps_each=3),
        # 16 bits round away the noise of the last levels.
        score=replace(MINUTES, scans=10_000, betas=(0.9, 0.999), precision="fp32"),
    ),
    "lidargen_kitti_360": preset(  # 29.7 M parameters
        "LiDARGen on KITTI-360 (set data.train and data.val to kitti_360:ROOT:SPLIT)",
        KITTI_360,
        LidarGenConfig(),
        published="LidarGRIT's table 1: SWD 33.93e-2, BEV MMD 2.19e-4, BEV JSD 5.70e-2, FPD 43.27 (5,000 test scans)",
        score=TrainingConfig(
            scans=100_000 * 24,  # the authors score the checkpoint of step 100,000; their configuration goes on
            batch_size=24,
            learning_rate=1e-4,
            betas=(0.9, 0.999),
            gradient_clip=0.0,
            average_over_scans=16_600,  # half-life of a decay of 0.999 every step of 24 scans
            validate_every=50_000,
            checkpoint_every=10_000,
        ),
    ),
}
