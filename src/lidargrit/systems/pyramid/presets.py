"""Presets of the pyramid of nearest ranges."""

from dataclasses import replace

from lidargrit.generation.presets import PIXEL_DECODER, PIXELS, WIDE_STREETS, preset
from lidargrit.systems.pyramid.system import PyramidConfig

PRESETS = {
    "pyramid_wide": preset(
        "nearest ranges from coarse to fine: 64x1024, for one CPU core and three hours",
        replace(WIDE_STREETS, train=("simulated:6000:train",)),
        PyramidConfig(pixels=replace(PIXEL_DECODER, mask_features=12, decoded_components=True, range_temperature=0.2)),
        levels=replace(
            PIXELS,
            scans=24_000,
            batch_size=8,
            learning_rate=2.5e-3,
            optimiser="muon",
            schedule="linear_second_half",
            warmup_scans=800,
            average_over_scans=1600,
            validate_every=8000,
            validation_scans=6,
            checkpoint_every=1600,
        ),
    ),
}
