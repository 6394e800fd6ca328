"""Tokenizer and pixel decoder of ``pretrained``, and a transformer trained anew in minutes: ``lidargrit demo``."""

from dataclasses import replace

from lidargrit.core.configuration import override
from lidargrit.systems.lidargrit.presets import compact_pixels

_DATA = ("data.train=simulated:256:train", "data.val=simulated:16:val")
_UNGUIDED = "model.guidance=1"  # the guidance of `pretrained` was chosen for its transformer
# Half as wide, a transformer learns nearly as much from a scan, and sees twice as many in the same time.
_SMALLER = ("model.transformer.layers=3", "model.transformer.width=192")
_TRANSFORMER = (
    "scans=2400",
    "warmup_scans=160",
    "average_over_scans=160",
    "validate_every=1200",
    "validation_scans=16",
    "checkpoint_every=480",
)

PRESET = replace(
    override(
        compact_pixels.PRESET,
        [*_DATA, *_SMALLER, _UNGUIDED, *(f"training.transformer.{each}" for each in _TRANSFORMER)],
    ),
    title="LidarGRIT whose transformer alone is trained, demo: 64x256 in 256 tokens, for two CPU cores, four minutes",
    stages_from="pretrained",
    train_anew=("transformer",),
)
