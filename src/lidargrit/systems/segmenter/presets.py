"""Presets of the network that labels scans."""

from dataclasses import replace

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.presets import LATER_STAGE, preset
from lidargrit.systems.segmenter.system import SegmenterConfig

PRESETS = {
    "segmenter_compact": preset(
        "a network that labels scans: 64x256, for one CPU core and a quarter of an hour",
        DataConfig(("simulated:400:train",), ("simulated:48:val",)),
        SegmenterConfig(),
        segmenter=replace(
            LATER_STAGE,
            scans=8000,
            batch_size=4,
            augmentations=("flip", "paste"),
            average_over_scans=300,
            validation_scans=32,
        ),
    )
}
