"""R2DM, R2Flow, LiDARCrafter: (5, rows, 1024) tensors of range, x, y, z in metres and reflectance → these two."""

from torch import Tensor

from lidargrit.data.sources.sample_formats import RangeAndReflectance, SampleFormat


def decode(scan: Tensor) -> RangeAndReflectance:
    """Take the range as it is, 0 where it lay outside of 1.45 to 80 m, and the last channel."""
    range_m = scan[0]
    return range_m, scan[4] * (range_m > 0)


r2dm = SampleFormat(
    title="R2DM's sample_and_save.py, and LiDARCrafter's sample_and_save_cond.py",
    source="kazuto1011/r2dm@004a1e4: sample_and_save.py, utils/lidar.py; worldbench/lidarcrafter@3c62da2: "
    "tools/evaluation/sample_and_save_cond.py",
    channels=5,
    sensors=(
        ("hdl64e_kitti_360", 0, 1),
        ("hdl32e_nuscenes", 0, 1),
    ),  # by elevation, its default; its images by ring look the same
    variant="clamped",
    decode=decode,
)
