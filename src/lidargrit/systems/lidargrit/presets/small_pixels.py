"""LidarGRIT with a pixel decoder at the size of ``small``, with a quarter of its tokens."""

from dataclasses import replace

from lidargrit.generation.pixel_decoder.pixel_networks import PixelDecoderConfig
from lidargrit.systems.lidargrit.presets import compact_pixels, small

_MODEL = small.PRESET.model

PRESET = replace(
    small.PRESET,
    title="LidarGRIT with a pixel decoder, small: 64x256 in 256 tokens, for one CPU core and four hours",
    model=replace(
        _MODEL,
        # Fewer tokens are learned sooner, and the pixel decoder adds the detail that they leave out.
        tokenizer=replace(_MODEL.tokenizer, channel_multipliers=(1, 1, 2, 4)),
        # Dropout costs likelihood in so short a training, see docs/results/transformer-preset.md.
        transformer=replace(_MODEL.transformer, embedding_dropout=0.0, residual_dropout=0.0),
        # Columns are 1.4 degrees apart and rows 0.4, so rows come closer last.
        pixels=PixelDecoderConfig(coarsest_cell=16, row_halvings=2, surface_components=True, gravity_components=True),
    ),
    training={
        **small.PRESET.training,
        "transformer": replace(compact_pixels.TRANSFORMER, scans=40_000),
        "pixels": replace(compact_pixels.PRESET.training["pixels"], scans=20_000),
    },
)
