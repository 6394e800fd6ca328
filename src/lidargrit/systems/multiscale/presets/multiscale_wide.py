"""A pixel decoder without tokens at 64x1024, whose last phases halve the distance between columns alone."""

from dataclasses import replace

from lidargrit.generation.pixel_decoder.pixel_networks import PixelDecoderConfig
from lidargrit.systems.multiscale.presets import multiscale_small
from lidargrit.systems.multiscale.system import MultiscaleConfig

PRESET = replace(
    multiscale_small.PRESET,
    title="a pixel decoder without tokens: 64x1024, for one CPU core and half an hour",
    model=MultiscaleConfig(PixelDecoderConfig(column_halvings=2, row_channels=2, range_width=36)),
    data=replace(
        multiscale_small.PRESET.data,
        train=("simulated:1000:train",),
        val=("simulated:24:val",),
        columns=2048,
        column_stride=2,
    ),
    training={
        "pixels": replace(
            multiscale_small.PRESET.training["pixels"],
            scans=3000,
            batch_size=1,
            average_over_scans=150,
            validate_every=500,
            validation_scans=12,
            checkpoint_every=250,
        )
    },
)
