"""LidarGRIT at 64x1024 with 4,096 tokens and a pixel decoder: what a relay of minutes of a GPU trains."""

from dataclasses import replace

from lidargrit.generators.lidargrit import LidarGritConfig
from lidargrit.nn.transformer import TransformerConfig
from lidargrit.recipes import compact_wide
from lidargrit.tokenizers.vqvae import VqvaeConfig
from lidargrit.training import FitConfig

# A relay ends when minutes end: the learning rate stays until half of a stage's scans are seen, then falls.
_STAGE = FitConfig(
    scans=60_000,
    batch_size=16,
    learning_rate=1e-3,
    schedule="linear_second_half",
    warmup_scans=1600,
    betas=(0.9, 0.98),
    precision="auto",
    any_columns=True,
    augmentations=("flip", "roll"),
    average_over_scans=2000,
    validate_every=10_000,
    checkpoint_every=10_000,
)

RECIPE = replace(
    compact_wide.RECIPE,
    title="LidarGRIT with a pixel decoder: 64x1024 in 4,096 tokens, for half an hour of a GPU",
    model=LidarGritConfig(
        # Cells of 8x2: of as many pixels as 4x4, and after as many scans they keep more of poles and trunks.
        tokenizer=VqvaeConfig(
            channels=64,
            channel_multipliers=(1, 1, 1, 2),
            cell_columns=2,
            code_dim=32,
            num_codes=2048,
            dropout=0.0,
            padding="wrap",
            range_encoding="log",
            reconstruction="returns",
            codebook_loss="ema",
            thin_weight=8.0,
        ),
        transformer=TransformerConfig(embedding_dropout=0.0),
        pixels=replace(compact_wide.RECIPE.model.pixels, mask_features=12, range_features=24, range_width=48),
    ),
    data=replace(compact_wide.RECIPE.data, workers=16),
    training={
        "tokenizer": _STAGE,
        "transformer": replace(_STAGE, scans=120_000, optimiser="muon", learning_rate=3e-3, augmentations=()),
        "pixels": replace(_STAGE, augmentations=()),
    },
    stages_from=None,
    fine_tune=(),
)
