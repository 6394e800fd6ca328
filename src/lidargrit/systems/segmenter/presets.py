"""Presets of the network that labels scans."""

from dataclasses import replace

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.presets import LATER_STAGE, WIDE_STREETS, preset
from lidargrit.systems.segmenter.system import SegmenterConfig

_SEGMENTER = replace(
    LATER_STAGE,
    scans=4000,
    batch_size=4,
    augmentations=("flip",),
    average_over_scans=300,
    validation_scans=32,
)

PRESETS = {
    "segmenter_compact": preset(
        "a network that labels scans: 64x256, for one CPU core and ten minutes",
        DataConfig(("simulated:400:train",), ("simulated:48:val",)),
        SegmenterConfig(),
        segmenter=_SEGMENTER,
    ),
    "segmenter_wide": preset(
        "a network that labels scans: 64x1024, for one CPU core and a quarter of an hour",
        replace(WIDE_STREETS, train=("simulated:400:train",)),
        SegmenterConfig(),
        stages_from="pretrained/segmenter",
        fine_tune=("segmenter",),
        segmenter=replace(_SEGMENTER, scans=1200, batch_size=2, learning_rate=1e-3, validation_scans=12),
    ),
}
