"""LidarGRIT's program: (1, 64, 1024) or (1, 64, 256) tensors of metres, 0 where nothing returned → metres."""

from torch import Tensor

from lidargrit.data.sources.sample_formats import RangeAndReflectance, SampleFormat


def decode(scan: Tensor) -> RangeAndReflectance:
    """Take the range as it is."""
    return scan[0], None


lidargrit = SampleFormat(
    title="the samples that LidarGRIT's program saves",
    source="hamedhaghighi/LidarGRIT@a3f86e7",
    channels=1,
    sensors=(("hdl64e_kitti_360", 2048, 2), ("hdl64e_kitti_odometry", 0, 1)),
    variant="reference",
    decode=decode,
)
