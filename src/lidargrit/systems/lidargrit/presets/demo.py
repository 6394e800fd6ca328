"""The small model on a few hundred simulated scans, trained in minutes, for ``lidargrit demo``."""

from dataclasses import replace

from lidargrit.core.configuration import override
from lidargrit.systems.lidargrit.presets import small

_DATA = ("data.train=simulated:300:train", "data.val=simulated:16:val")
_TOKENIZER = ("scans=2400", "validate_every=800", "checkpoint_every=400")
_TRANSFORMER = ("scans=4800", "validate_every=1600", "checkpoint_every=400")
_TRAINING = [f"training.tokenizer.{each}" for each in _TOKENIZER] + [f"training.transformer.{e}" for e in _TRANSFORMER]

PRESET = replace(
    override(small.PRESET, [*_DATA, *_TRAINING]),
    title="LidarGRIT, demo: the small model for a few minutes",
)
