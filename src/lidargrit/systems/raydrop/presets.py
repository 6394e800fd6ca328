"""Presets of the network that tells which surfaces of clean scans return."""

from dataclasses import replace

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.presets import LATER_STAGE, any_sensor, preset
from lidargrit.systems.raydrop.network import RaydropNetworkConfig
from lidargrit.systems.raydrop.system import RaydropConfig

_RAYDROP = replace(
    LATER_STAGE, scans=4000, batch_size=4, augmentations=("flip",), average_over_scans=300, validation_scans=32
)

PRESETS = {
    "raydrop_compact": preset(
        "a network of raydrop for clean scans: 64x256, for one CPU core and ten minutes",
        DataConfig(
            ("simulated_surfaces:512:train",), ("simulated_surfaces:64:val",)
        ),  # of which all surfaces are known
        RaydropConfig(),
        raydrop=_RAYDROP,
    ),
    "raydrop_any": preset(
        "a network of raydrop for clean scans of any spinning sensor: for one CPU core and ten minutes",
        any_sensor("simulated_surfaces", 1024),
        RaydropConfig(RaydropNetworkConfig(any_sensor=True)),
        raydrop=replace(_RAYDROP, start="pretrained/raydrop"),
    ),
}
