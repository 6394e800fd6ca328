"""Presets of the forecaster of drives."""

from dataclasses import replace

from lidargrit.generation.presets import PIXEL_DECODER, PIXELS, STREETS, preset
from lidargrit.systems.forecaster.system import ForecasterConfig

PRESETS = {
    # Drives have to be simulated first: lidargrit simulate drives -n 2000 --frames 12
    "forecaster_compact": preset(
        "the next scan of a drive: 64x256, for one CPU core and two hours",
        replace(STREETS, train=("kitti_odometry:drives:all",), condition="past"),
        ForecasterConfig(replace(PIXEL_DECODER, mask_features=12, coarse_range_width=48, decoded_components=True)),
        pixels=replace(
            PIXELS,
            scans=12_000,
            batch_size=4,
            optimiser="muon",
            schedule="linear_second_half",
            average_over_scans=600,
        ),
    ),
}
