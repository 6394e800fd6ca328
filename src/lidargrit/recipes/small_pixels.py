"""The recipe ``small`` with a pixel decoder, which samples returns and ranges in phases from coarse to fine."""

from dataclasses import replace

from lidargrit.nn.pixel_networks import PixelDecoderConfig
from lidargrit.recipes import compact_pixels, small

RECIPE = replace(
    small.RECIPE,
    title="LidarGRIT with a pixel decoder, small: 64x256, for two CPU cores and three hours",
    model=replace(small.RECIPE.model, pixels=PixelDecoderConfig()),
    training={
        **small.RECIPE.training,
        "transformer": compact_pixels.TRANSFORMER,
        "pixels": compact_pixels.RECIPE.training["pixels"],
    },
)
