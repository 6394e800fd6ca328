"""LidarGRIT at a size that two CPU cores can train in an hour or two, on simulated or on your own scans."""

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.settings import FitConfig, Preset
from lidargrit.generation.tokenizers.vqvae import VqvaeConfig
from lidargrit.nn.transformer import TransformerConfig
from lidargrit.systems.lidargrit.system import LidarGritConfig

PRESET = Preset(
    title="LidarGRIT, small: 64x256, for two CPU cores and an hour or two",
    generator="lidargrit",
    model=LidarGritConfig(
        tokenizer=VqvaeConfig(
            channels=32,
            channel_multipliers=(1, 1, 2),
            code_dim=64,
            num_codes=512,
            dropout=0.0,
            padding="wrap",
            range_encoding="log",  # with errors in metres learns quicker than the linear one, see docs/results
            error_unit="metres",
            reconstruction="returns",
            codebook_loss="ema",
        ),
        transformer=TransformerConfig(layers=4, heads=4, width=192, embedding_dropout=0.1, residual_dropout=0.1),
    ),
    data=DataConfig(train=("simulated:2000:train",), val=("simulated:32:val",)),
    training={
        "tokenizer": FitConfig(
            scans=20_000,
            batch_size=2,
            learning_rate=1.5e-3,
            schedule="cosine",
            warmup_scans=300,
            precision="auto",
            augmentations=("flip", "roll"),
            any_columns=True,
            average_over_scans=300,
            validate_every=1000,
            checkpoint_every=500,
        ),
        "transformer": FitConfig(
            scans=20_000,
            batch_size=8,
            learning_rate=1e-3,
            schedule="cosine",
            warmup_scans=500,
            weight_decay=0.01,
            precision="auto",
            augmentations=("flip",),
            any_columns=True,
            average_over_scans=500,
            validate_every=1000,
            checkpoint_every=500,
        ),
    },
)
