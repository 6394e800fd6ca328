"""Presets of the network that tells which surfaces of clean scans return."""

from dataclasses import replace

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.presets import LATER_STAGE, preset
from lidargrit.systems.raydrop.system import RaydropConfig

PRESETS = {
    "raydrop_compact": preset(
        "a network of raydrop for clean scans: 64x256, for one CPU core and ten minutes",
        DataConfig(
            ("simulated_surfaces:512:train",), ("simulated_surfaces:64:val",)
        ),  # of which all surfaces are known
        RaydropConfig(),
        raydrop=replace(
            LATER_STAGE,
            scans=4000,
            batch_size=4,
            augmentations=("flip",),
            average_over_scans=300,
            validation_scans=32,
        ),
    ),
}
