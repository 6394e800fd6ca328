"""Range images as 16-bit PNG, 64 rows high ⇄ :class:`Scan` with a ring per point."""

import struct
import warnings
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt16
from PIL import Image

from lidargrit.core.errors import ScanError
from lidargrit.core.files import atomic_path
from lidargrit.data.formats import BadPoints, ScanFormat, damaged, first_bytes, read_bytes
from lidargrit.scans.projection import project, unproject
from lidargrit.scans.sensors import SensorModel, column_azimuths_rad, load_sensor
from lidargrit.scans.types import RangeImage, Scan

_ROWS, _COLUMNS_AT_MOST = 64, 16_384
_COLUMNS_WRITTEN = 870  # of the Karlsruhe recordings
_HEADER_BYTES = 26  # up to the size, the bits and the colours
_BYTES_AT_MOST = 10_000_000  # the most columns fill 2 MB, if nothing in them can be packed
_VALUES_PER_M = 500
_TOP_DEG, _BOTTOM_DEG = 1.94, -25.0
_TAKEN = (
    f"taken as steps of {1000 // _VALUES_PER_M} mm and rows from {_TOP_DEG:+g} to {_BOTTOM_DEG:g} degrees; for other "
    "steps or rows save ranges in metres as .npy, and name the sensor (--sensor, --set data.columns=N)"
)
_FORMAT = "a 16-bit grey PNG of 64 rows: value / 500 = metres, 0 = no return"


class RangePng(ScanFormat):
    """Velodyne range images as recorded in Karlsruhe (KIT/MRT, F. Moosmann), and others of their kind.

    Row 0 is the highest laser, columns fall in azimuth from +180 to -180 degrees, there is no reflectance. The images
    carry no elevation per row: points are placed on 64 equally spaced ones from +1.94 to -25 degrees, up to 3.5
    degrees from where an HDL-64E's unequal rows look, and should be projected by their ``ring`` (unfolding), which
    keeps rows and ranges.
    """

    title = "range image as 16-bit PNG of 64 rows"
    suffixes = (".png",)
    reflectance = "none"
    frame = "pixels; rows fall in elevation, columns in azimuth"
    sensor = "hdl64e_kitti_odometry"
    keeps = ("ring",)

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether a file begins as a 16-bit grey PNG of 64 rows."""
        try:
            _columns(first_bytes(path, _HEADER_BYTES), path)
        except ScanError:
            return False
        return True

    @staticmethod
    def read(path: Path, index: int = 0, bad_points: BadPoints = "refuse") -> Scan:
        """Read one image as points on the centres of its columns; ``bad_points`` has no effect, 0 is the only one."""
        range_m = torch.from_numpy(_pixels(path).astype(np.float32) / np.float32(_VALUES_PER_M))
        if not bool(range_m.any()):
            raise ScanError(f"no return in {path}", "a range in some pixel", "remove the file")
        image = RangeImage(range_m, range_m > 0, _rays(range_m.shape[1]))
        notes = () if range_m.shape[1] == _COLUMNS_WRITTEN else (_TAKEN,)  # which images of other programs may not mean
        return replace(unproject(image), source=str(path), notes=notes)

    @classmethod
    def write(cls, path: Path, scan: Scan) -> None:
        """Write a scan as an image of 870 columns, as the Karlsruhe recordings have."""
        image = project(scan, load_sensor(cls.sensor).with_columns(_COLUMNS_WRITTEN))
        values = (image.range_m * _VALUES_PER_M).round().clamp(max=65_535)
        with atomic_path(path) as temporary:
            Image.fromarray(values.numpy().astype(np.uint16)).save(temporary, format="PNG")


def _rays(columns: int) -> SensorModel:
    elevation_deg = torch.linspace(_TOP_DEG, _BOTTOM_DEG, _ROWS, dtype=torch.float64)
    return SensorModel(
        name="rows of a range image",
        elevation_rad=elevation_deg.deg2rad().float()[:, None],
        azimuth_rad=column_azimuths_rad(columns),
        range_min_m=1 / _VALUES_PER_M,
        range_max_m=65_535 / _VALUES_PER_M,
        projection="unfolding",
    )


def _pixels(path: Path) -> UInt16[np.ndarray, "64 W"]:
    data = read_bytes(path, _BYTES_AT_MOST, _FORMAT)
    size = (_columns(data[:_HEADER_BYTES], path), _ROWS)  # before pixels are unpacked: they could be gigabytes
    try:
        # Not from the path: the decoder would make room for whatever length a chunk of the file claims.
        with warnings.catch_warnings(action="ignore"), Image.open(BytesIO(data), formats=("PNG",)) as image:
            if (image.mode, image.size) != ("I;16", size):  # a later chunk can contradict the header
                raise ValueError(f"{image.mode} pixels, {image.size}")
            return np.array(image, dtype=np.uint16)
    except Exception as error:  # the decoder meets a damaged file with whatever its chunks make it stumble over
        raise damaged(path, _FORMAT, error) from None


def _columns(header: bytes, path: Path) -> int:
    if len(header) < _HEADER_BYTES or header[:8] != b"\x89PNG\r\n\x1a\n":
        raise ScanError(f"{path}, which is no PNG", _FORMAT, "convert the image, or remove the file")
    columns, rows, bits, colour = struct.unpack(">IIBB", header[16:])
    if (rows, bits, colour) != (_ROWS, 16, 0) or not 1 <= columns <= _COLUMNS_AT_MOST:
        raise ScanError(
            f"{path}, a PNG of {rows} rows and {columns} columns with {bits} bits{'' if colour == 0 else ' in colour'}",
            _FORMAT,
            "give the images of a 64-beam sensor, or convert them",
        )
    return columns
