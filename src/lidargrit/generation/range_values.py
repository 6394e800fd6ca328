"""Range images ⇄ log ranges in [-1, 1], beside them reflectance; no return is a level below that of every return."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidargrit.core.errors import ConfigError
from lidargrit.generation.reflectance import reflectance_of_returns
from lidargrit.scans.projection import RangeEncoding
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage


def encode(images: RangeImage, with_reflectance: bool) -> Float[Tensor, "B C H W"]:
    """Map a batch to the network's input: log2(1 + range) over that of the limit, in [-1, 1], -1 without a return.

    The shortest range of a return lies above -1: at -0.59 for 1.45 m of 80 m. Between the two is nothing, which is how
    the published models of R2DM and R2Flow tell a return from none.
    """
    if images.range_m.ndim != 3:
        raise ConfigError("a single range image", "a batch", "make one with RangeImage.stack([image])")
    level = _log_range(images.sensor).encode(images.range_m, images.return_mask)
    if not with_reflectance:
        return level[:, None]
    reflectance = reflectance_of_returns(images)
    return torch.stack((level, 2 * reflectance * images.return_mask - 1), dim=1)


def decode(
    values: Float[Tensor, "B C H W"], sensor: SensorModel, returned: Bool[Tensor, "B H W"] | None = None
) -> RangeImage:
    """Map the output of a network to range images; a second channel is reflectance.

    Args:
        values: channels in [-1, 1], which are clipped to it: the encoded range, and the reflectance where there is one.
        returned: mask of the returns; by default the pixels whose range is longer than the sensor's shortest.
    """
    encoding = _log_range(sensor)
    range_m = encoding.decode(values[:, 0])
    if returned is None:
        # The programs cut values to [-1, 1], decode them and keep what lies between the limits, 1.45 and 80 m. A value
        # of 1 is a return there, as 80 m is rounded to just below itself; farther limits may be rounded upwards, so
        # they are not compared with. The power is taken in 64 bits: in 32 its last bit differs with a batch's size.
        returned = torch.exp2(encoding.curve(values[:, 0]).double()) - 1 > sensor.range_min_m
    image = RangeImage.masked(range_m.clamp(sensor.range_min_m, sensor.range_max_m), returned, sensor)
    if values.shape[1] == 1:
        return image
    return image.with_planes(reflectance=((values[:, 1] + 1) / 2).clamp(0, 1) * returned)


def _log_range(sensor: SensorModel) -> RangeEncoding:
    """Return the encoding of both programs: log2(1 + range) of 0 m and of the far limit at both ends."""
    return RangeEncoding("log", 0.0, sensor.range_max_m)
