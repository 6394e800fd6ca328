"""``pretrained``, trained further for some minutes on scans of a user: ``lidargrit demo --data SCANS``."""

from dataclasses import replace

from lidargrit.core.configuration import override
from lidargrit.systems.lidargrit.presets import compact_pixels

# A fifth of the rates at which the weights were learned, as docs/how-to/train.md says.
_FURTHER = {
    "tokenizer": ("scans=200", "learning_rate=3e-4", "average_over_scans=40"),
    "transformer": ("scans=800", "learning_rate=6e-4", "average_over_scans=80"),
    "pixels": ("scans=240", "learning_rate=4e-4", "average_over_scans=40"),
}
_EACH = ("warmup_scans=40", "validate_every=400", "validation_scans=8", "checkpoint_every=80")

PRESET = replace(
    override(
        compact_pixels.PRESET,
        [f"training.{stage}.{each}" for stage, settings in _FURTHER.items() for each in (*settings, *_EACH)],
    ),
    title="LidarGRIT trained further, demo: 64x256 in 256 tokens, for two CPU cores and four minutes",
    stages_from="pretrained",
    fine_tune=("tokenizer", "transformer", "pixels"),
)
