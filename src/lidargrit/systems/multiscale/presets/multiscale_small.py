"""A pixel decoder without tokens at 64x256, for compression and to measure what tokens contribute."""

from dataclasses import replace

from lidargrit.generation.pixel_decoder.pixel_networks import PixelDecoderConfig
from lidargrit.generation.settings import Preset
from lidargrit.systems.lidargrit.presets import compact_pixels
from lidargrit.systems.multiscale.system import MultiscaleConfig

# One pixel of each 64x64 comes first, so that coarse pixels know of one another, which no token tells them here.
PRESET = Preset(
    title="a pixel decoder without tokens, small: 64x256, for one CPU core and half an hour",
    generator="multiscale",
    model=MultiscaleConfig(
        PixelDecoderConfig(
            coarsest_cell=64, row_channels=2, range_width=36, surface_components=True, gravity_components=True
        )
    ),
    data=replace(compact_pixels.PRESET.data, train=("simulated:4352:train",)),
    training={"pixels": replace(compact_pixels.PRESET.training["pixels"], scans=16_000, average_over_scans=700)},
)
