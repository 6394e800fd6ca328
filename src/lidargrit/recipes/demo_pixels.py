"""The model in the package at a still smaller size, trained in six minutes on two CPU cores, for ``lidargrit demo``."""

from dataclasses import replace

from lidargrit.configuration import override
from lidargrit.recipes import compact_pixels

_DATA = ("data.train=simulated:256:train", "data.val=simulated:16:val")
_SMALLER = ("model.transformer.layers=3", "model.transformer.width=192")
# So few scans that each stage takes about a quarter to a half of the time: measured step by step, in 32 bits.
_TOKENIZER = ("scans=640", "warmup_scans=40", "average_over_scans=60", "validate_every=320", "checkpoint_every=160")
_TRANSFORMER = (
    "scans=2400",
    "warmup_scans=160",
    "average_over_scans=160",
    "validate_every=1200",
    "checkpoint_every=480",
)
_PIXELS = ("scans=320", "warmup_scans=32", "average_over_scans=32", "validate_every=160", "checkpoint_every=80")
_TRAINING = [
    f"training.{stage}.{each}"
    for stage, settings in (("tokenizer", _TOKENIZER), ("transformer", _TRANSFORMER), ("pixels", _PIXELS))
    for each in (*settings, "validation_scans=8")
]

RECIPE = replace(
    override(compact_pixels.RECIPE, [*_DATA, *_SMALLER, *_TRAINING]),
    title="LidarGRIT with a pixel decoder, demo: 64x256 in 256 tokens, for two CPU cores and six minutes",
)
