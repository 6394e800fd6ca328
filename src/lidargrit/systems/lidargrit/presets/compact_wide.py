"""LidarGRIT with a pixel decoder at 64x1024: ``pretrained_wide``, trained further from ``pretrained``."""

from dataclasses import replace

from lidargrit.systems.lidargrit.presets import compact_pixels
from lidargrit.systems.multiscale.presets import multiscale_wide

_STAGES = compact_pixels.PRESET.training

PRESET = replace(
    compact_pixels.PRESET,
    title="LidarGRIT with a pixel decoder: 64x1024 in 1,024 tokens, for one CPU core and five hours",
    # Columns are four times as near as those of 64x256: at its temperature there are too many edges.
    model=replace(
        compact_pixels.PRESET.model,
        pixels=replace(compact_pixels.PRESET.model.pixels, range_temperature=0.2),
        guidance=1.0,  # without any, regions of its samples differ in drops as those of validation streets do
    ),
    data=replace(multiscale_wide.PRESET.data, train=compact_pixels.PRESET.data.train),
    training={
        # An image of 64x1024 is as much to learn from as four of 64x256.
        "tokenizer": replace(_STAGES["tokenizer"], scans=800, batch_size=1, learning_rate=5e-4, validate_every=400),
        "transformer": replace(_STAGES["transformer"], scans=17_600, batch_size=4, validate_every=1200),
        "pixels": replace(_STAGES["pixels"], scans=12_200, batch_size=1, learning_rate=1e-3, validate_every=1000),
    },
    stages_from="pretrained",
    fine_tune=("tokenizer", "transformer", "pixels"),
)
