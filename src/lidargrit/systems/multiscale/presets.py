"""Presets of a pixel decoder without tokens, for compression and to measure what tokens contribute."""

from dataclasses import replace

from lidargrit.generation.pixel_decoder.phase_network import PixelDecoderConfig
from lidargrit.generation.presets import ANY_SENSOR, MORE_STREETS, PIXEL_DECODER, PIXELS, WIDE_STREETS, preset
from lidargrit.systems.multiscale.system import MultiscaleConfig

PRESETS = {
    # One pixel of each 64x64 comes first, so that coarse pixels know of one another, which no token tells them here.
    "multiscale_small": preset(
        "a pixel decoder without tokens, small: 64x256, for one CPU core and half an hour",
        MORE_STREETS,
        MultiscaleConfig(PIXEL_DECODER),
        pixels=replace(PIXELS, scans=16_000, average_over_scans=700),
    ),
    "multiscale_any": preset(
        "a pixel decoder without tokens for any spinning sensor: for one CPU core and an hour",
        ANY_SENSOR,
        MultiscaleConfig(replace(PIXEL_DECODER, row_channels=4, any_sensor=True)),
        pixels=replace(PIXELS, scans=16_000, average_over_scans=700),
    ),
    # The last phases halve the distance between columns alone.
    "multiscale_wide": preset(
        "a pixel decoder without tokens: 64x1024, for one CPU core and half an hour",
        WIDE_STREETS,
        MultiscaleConfig(PixelDecoderConfig(column_halvings=2, row_channels=2, range_width=36)),
        pixels=replace(
            PIXELS,
            scans=3000,
            batch_size=1,
            average_over_scans=150,
            validate_every=500,
            validation_scans=12,
            checkpoint_every=250,
        ),
    ),
}
