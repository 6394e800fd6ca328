"""``pretrained`` at a still smaller size, trained in ten minutes on two CPU cores, for ``lidargrit demo``."""

from dataclasses import replace

from lidargrit.core.configuration import override
from lidargrit.systems.lidargrit.presets import compact_pixels

_DATA = ("data.train=simulated:256:train", "data.val=simulated:16:val")
_UNGUIDED = "model.guidance=1"  # the guidance of `pretrained` was chosen for its transformer
# Few codes, a small transformer and small batches: more to learn from as few scans as minutes allow.
_SMALLER = ("model.tokenizer.num_codes=256", "model.transformer.layers=3", "model.transformer.width=192")
# In 32 bits a scan costs the tokenizer 0.4, the transformer 0.08 and the pixel decoder 0.27 seconds of one core.
_TOKENIZER = ("scans=600", "warmup_scans=40", "average_over_scans=60", "validate_every=300", "checkpoint_every=150")
_TRANSFORMER = (
    "scans=2400",
    "warmup_scans=160",
    "average_over_scans=160",
    "validate_every=1200",
    "checkpoint_every=480",
)
_PIXELS = ("scans=280", "warmup_scans=28", "average_over_scans=28", "validate_every=140", "checkpoint_every=70")
_TRAINING = [
    f"training.{stage}.{each}"
    for stage, settings in (("tokenizer", _TOKENIZER), ("transformer", _TRANSFORMER), ("pixels", _PIXELS))
    for each in (*settings, "validation_scans=8")
]

PRESET = replace(
    override(compact_pixels.PRESET, [*_DATA, *_SMALLER, _UNGUIDED, *_TRAINING]),
    title="LidarGRIT with a pixel decoder, demo: 64x256 in 256 tokens, for two CPU cores and ten minutes",
)
