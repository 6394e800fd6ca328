"""The paper's ablation on KITTI odometry, second row: raydrop loss, no geometric preservation.

The third row, with both, is ``lidargrit_kitti_odometry``; nothing but its augmentation is left out here.

Source:
    Haghighi et al., LidarGRIT, 2024, section 4.3 and table 3.
"""

from dataclasses import replace

from lidargrit.core.configuration import override
from lidargrit.systems.lidargrit.presets import lidargrit_kitti_odometry

PRESET = replace(
    override(lidargrit_kitti_odometry.PRESET, ["training.tokenizer.augmentations=[]"]),
    title="the paper's ablation, row 2: with raydrop loss, without geometric preservation",
    published="SWD 17.68e-2, min. matching distance 1.66e-3, JSD 1.99e-2, FPD 122 (paper, table 3; 5,000 test scans)",
)
