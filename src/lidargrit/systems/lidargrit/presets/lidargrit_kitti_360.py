"""The paper's KITTI-360 experiment: spherical projection to 64x1024, 17.3 M + 10.3 M parameters."""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Preset
from lidargrit.generation.tokenizers.vqvae import VqvaeConfig
from lidargrit.nn.transformer import TransformerConfig
from lidargrit.systems.lidargrit.system import LidarGritConfig

_TRAIN_SCANS = 50_000  # roughly one epoch of the training drives; the paper trains for 100

PRESET = Preset(
    title="LidarGRIT on KITTI-360 (set data.train and data.val to kitti_360:ROOT:SPLIT)",
    generator="lidargrit",
    model=LidarGritConfig(
        tokenizer=VqvaeConfig(
            channels=128, channel_multipliers=(1, 1, 2, 2), code_dim=256, num_codes=1024, restart_dead_codes=False
        ),
        transformer=TransformerConfig(layers=12, heads=8, width=256, embedding_dropout=0.0),
    ),
    data=DataConfig(
        train=("kitti_360:data/kitti_360:train_without_val",),
        val=("kitti_360:data/kitti_360:val",),
        sensor="hdl64e_kitti_360",
    ),
    training={
        "tokenizer": FitConfig(
            scans=100 * _TRAIN_SCANS,
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
            batch_size=16,
            learning_rate=7.2e-5,
            schedule="linear_second_half",
            betas=(0.9, 0.95),
            weight_decay=0.01,
            gradient_clip=0.0,
            average_over_scans=20_000,
            validate_every=_TRAIN_SCANS,
            checkpoint_every=10_000,
        ),
    },
    seed=6,
    published="SWD 10.29e-2, BEV MMD 2.16e-4, BEV JSD 3.93e-2, FPD 12.54 (paper, table 1; 5,000 test scans)",
)
