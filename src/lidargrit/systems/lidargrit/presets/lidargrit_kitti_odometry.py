"""The paper's KITTI odometry experiment: unfolding to 64x256, 3.1 M + 5.3 M parameters."""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Preset
from lidargrit.generation.tokenizers.vqvae import VqvaeConfig
from lidargrit.nn.transformer import TransformerConfig
from lidargrit.systems.lidargrit.system import LidarGritConfig

_TRAIN_SCANS = 19_130  # of sequences 00 to 07, 09 and 10: one epoch; the released configuration trains for 70 and 100

PRESET = Preset(
    title="LidarGRIT on KITTI odometry (set data.train and data.val to kitti_odometry:ROOT:SPLIT)",
    generator="lidargrit",
    model=LidarGritConfig(
        tokenizer=VqvaeConfig(
            channels=64, channel_multipliers=(1, 1, 2), code_dim=128, num_codes=512, restart_dead_codes=False
        ),
        transformer=TransformerConfig(layers=6, heads=8, width=256, embedding_dropout=0.2),
    ),
    data=DataConfig(
        train=("kitti_odometry:data/kitti_odometry:train",), val=("kitti_odometry:data/kitti_odometry:val",)
    ),
    training={
        "tokenizer": FitConfig(
            scans=70 * _TRAIN_SCANS,
            batch_size=8,
            learning_rate=8e-6,
            betas=(0.5, 0.9),
            gradient_clip=0.0,
            augmentations=("geometric",),
            average_over_scans=20_000,
            validate_every=_TRAIN_SCANS,
            checkpoint_every=10_000,
        ),
        "transformer": FitConfig(
            scans=100 * _TRAIN_SCANS,
            batch_size=1,
            learning_rate=4.5e-6,
            betas=(0.9, 0.95),
            weight_decay=0.01,
            gradient_clip=0.0,
            average_over_scans=20_000,
            validate_every=_TRAIN_SCANS,
            checkpoint_every=10_000,
        ),
    },
    seed=6,
    published="SWD 15.15e-2, min. matching distance 1.65e-3, JSD 2.06e-2, FPD 116 (paper, table 2; 5,000 test scans)",
)
