"""Presets of the forecaster of drives."""

from dataclasses import replace

from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.presets import PIXEL_DECODER, PIXELS, preset
from lidargrit.systems.forecaster.system import ForecasterConfig

PRESETS = {
    # Drives are simulated first: lidargrit simulate drives -n 2000 --frames 12, and drives_val with --seed 1000000
    "forecaster_compact": preset(
        "the next scan of a drive: 64x256, for one CPU core and two hours",
        DataConfig(("kitti_odometry:drives:all",), ("kitti_odometry:drives_val:all",), condition="past"),
        ForecasterConfig(
            replace(PIXEL_DECODER, mask_features=12, coarse_range_width=48, decoded_components=True), own_past=0.25
        ),
        pixels=replace(
            PIXELS,
            scans=12_000,
            batch_size=4,
            optimiser="muon",
            schedule="linear_second_half",
            average_over_scans=600,
            start="pretrained/lidargrit",
        ),
    )
}
