"""LiDM and R3DPA: text of x, y, z and three zeros, a point on the first edges of each pixel → metres of the pixels."""

import math
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lidargrit.core.errors import ScanError
from lidargrit.data.formats import read_bytes
from lidargrit.data.sources.sample_formats import RangeAndReflectance, SampleFormat
from lidargrit.scans.sensors import load_sensor

_BYTES_AT_MOST = 1 << 26  # of one file: 65,536 points take 3 MB
_TOP_DEG, _BOTTOM_DEG = 3.0, -25.0
_OFF_AT_MOST = 0.1  # of a pixel, in the mean: text in millimetres has 0.01, points that lie anywhere 0.25
_WANTED, _CURE = "lines of x y z and three zeros, as LiDM writes them", "score other clouds as .csv, with a head x y z"


def read(path: Path) -> Tensor:
    """Return the ranges of pixels (1, 64, 1024), the nearest point of each.

    Projected like a scan, half of the points would fall into a neighbouring pixel, for they lie on the edges, and a
    third of the pixels would be lost.
    """
    data = read_bytes(path, _BYTES_AT_MOST, _WANTED)
    try:
        points_m = np.loadtxt(BytesIO(data), dtype=np.float64, ndmin=2)
    except ValueError as error:
        raise ScanError(f"{path}, which cannot be used ({error})", _WANTED, _CURE) from None
    if points_m.shape[1] != 6 or points_m[:, 3:].any() or not np.isfinite(points_m).all():
        raise ScanError(f"rows of {points_m.shape[1]} numbers in {path}", _WANTED, _CURE)
    range_m = np.linalg.norm(points_m[:, :3], axis=1)
    if not range_m.any():
        raise ScanError(f"no point in {path}", "a scan with returns", "sample anew: LiDM writes such files unnoticed")
    (x_m, y_m, z_m, *_), range_m = points_m[range_m > 0].T, range_m[range_m > 0]
    sensor = load_sensor(lidm.sensors[0][0])
    height, width = sensor.height, sensor.width
    row = (_TOP_DEG - np.degrees(np.arcsin(z_m / range_m))) / (_TOP_DEG - _BOTTOM_DEG) * height
    column = (1 - np.arctan2(y_m, x_m) / math.pi) / 2 * width
    off = max(float(np.abs(at - np.rint(at)).mean()) for at in (row, column))
    if not off < _OFF_AT_MOST:
        wanted = "points on the first edges of pixels, as LiDM and R3DPA write them"
        raise ScanError(f"points {off:.2f} pixels away from edges in {path}", wanted, _CURE)
    image_m = np.full((height, width), np.inf)
    pixel = np.rint(row).astype(int).clip(0, height - 1), np.rint(column).astype(int) % width
    np.minimum.at(image_m, pixel, range_m)
    return torch.from_numpy(np.where(np.isfinite(image_m), image_m, 0))[None].float()


def decode(scan: Tensor) -> RangeAndReflectance:
    """Take the range as it is; there is no reflectance."""
    return scan[0], None


lidm = SampleFormat(
    title="LiDM's scripts/sample.py and R3DPA's generate.py",
    source="hancyran/LiDAR-Diffusion@4c94f10: scripts/sample.py; valeoai/R3DPA@2789885: generate.py",
    channels=1,
    sensors=(("hdl64e_kitti_360", 0, 1),),
    variant="clamped",
    decode=decode,
    suffix=".txt",
    read=read,
)
