"""LiDARGen: (2, 64, 1024) tensors of log2(range + 1) / 6 and intensity, both in [0, 1] → metres and reflectance."""

import torch
from torch import Tensor

from lidargrit.data.sources.sample_formats import RangeAndReflectance, SampleFormat

_NEAR_M, _FAR_M = 0.5, 63.0  # the widest window of its scores; there is no other sign of a missing return


def decode(scan: Tensor) -> RangeAndReflectance:
    """Undo the logarithm; what lies outside of 0.5 to 63 m is no return."""
    range_m = torch.exp2(6 * scan[0]) - 1
    returned = (range_m > _NEAR_M) & (range_m < _FAR_M)
    return torch.where(returned, range_m, 0), torch.where(returned, scan[1], 0)


lidargen = SampleFormat(
    title="LiDARGen's sampler",
    source="vzyrianov/lidargen@b88030b: LiDARGen/runners/ncsn_runner.py, metrics/histogram/hist_utils.py",
    channels=2,
    sensors=(("hdl64e_kitti_360", 0, 1),),
    variant="clamped",
    decode=decode,
)
