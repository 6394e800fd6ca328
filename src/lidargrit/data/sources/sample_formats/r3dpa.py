"""R3DPA: img.npz of (scans, 5, 64, 1024) depth, x, y, z and zeros, mostly many GB → metres, read scan by scan."""

from pathlib import Path

import torch
from torch import Tensor

from lidargrit.core.arrays import mapped_member
from lidargrit.core.errors import ScanError
from lidargrit.data.sources.sample_formats import RangeAndReflectance, SampleFormat

_NEAR_M, _FAR_M = 1.0, 56.0  # between which evaluate.py takes a depth for a return


def read(path: Path) -> Tensor:
    """Return the array of the file, which stays on the disk.

    Raises:
        ScanError: no such array.
    """
    try:
        return torch.from_numpy(mapped_member(path, "arr_0"))
    except (TypeError, ValueError) as error:  # the first by numbers of the other byte order
        wanted = "an array arr_0 of floats, as np.savez writes it"
        got = f"{path}, which cannot be used ({error})"
        raise ScanError(got, wanted, "sample anew, or score the folder pcd beside it") from None


def decode(scan: Tensor) -> RangeAndReflectance:
    """Take the depth where it is a return; there is no reflectance."""
    depth_m = scan[0].float()
    return torch.where((depth_m > _NEAR_M) & (depth_m < _FAR_M), depth_m, 0), None


r3dpa = SampleFormat(
    title="R3DPA's generate.py, numpy/img.npz",
    source="valeoai/R3DPA@2789885: generate.py, dataset_kitti.py, evaluate.py",
    channels=5,
    sensors=(("hdl64e_kitti_360", 0, 1),),
    variant="clamped",
    decode=decode,
    suffix=".npz",
    read=read,
)
