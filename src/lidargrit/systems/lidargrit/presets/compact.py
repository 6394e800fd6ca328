"""LidarGRIT with 8x32 tokens for an image of 64x256, trained on the simulator."""

from dataclasses import replace

from lidargrit.core.configuration import override
from lidargrit.systems.lidargrit.presets import small

# A quarter of the tokens of ``small`` for little of its detail: the transformer learns, and generates, sooner.
_FEWER_TOKENS = ("model.tokenizer.channel_multipliers=1,1,2,4", "model.tokenizer.num_codes=1024")
_TRANSFORMER = ("model.transformer.layers=5", "model.transformer.width=256")

PRESET = replace(
    override(small.PRESET, [*_FEWER_TOKENS, *_TRANSFORMER, "training.tokenizer.scans=8000"]),
    title="LidarGRIT: 64x256 in 256 tokens, for one CPU core and an hour",
)
