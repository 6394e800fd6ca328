"""Range images as 16-bit PNG, 64 rows high: ROOT/DRIVE/*.png → scans with a ring per point."""

from __future__ import annotations

import struct
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt16
from PIL import Image

from lidargrit.datasets import BadPoints
from lidargrit.datasets._files import FileDataset
from lidargrit.errors import ScanError
from lidargrit.projection import project, unproject
from lidargrit.sensors import SensorModel, column_azimuths_rad, load_sensor
from lidargrit.structures import RangeImage, Scan

_ROWS, _COLUMNS_AT_MOST = 64, 16_384
_VALUES_PER_M = 500
_TOP_DEG, _BOTTOM_DEG = 1.94, -25.0
_FORMAT = "a 16-bit grey PNG of 64 rows: value / 500 = metres, 0 = no return"


class RangeImageFiles(FileDataset):
    """Velodyne range images as recorded in Karlsruhe (KIT/MRT, F. Moosmann), and others of their kind.

    Row 0 is the highest laser, columns fall in azimuth from +180 to -180 degrees, there is no reflectance. The images
    carry no elevation per row: points are placed on 64 equally spaced ones from +1.94 to -25 degrees, up to 3.5
    degrees from where an HDL-64E's unequal rows look, and should be projected by their ``ring`` (unfolding), which
    keeps rows and ranges. A drive is a subfolder; there are no named splits.

    An image of 870 columns fills 870 of the sensor's 2048 fine columns, and so 109 of the 256 that are kept. To have
    every pixel of the file, project with ``load_sensor(...).with_columns(870)``.
    """

    title = "range images as PNG"
    licence = "that of your files; the Karlsruhe recordings' publisher states none"
    tree = "ROOT/DRIVE/*.png (16 bit, 64 rows)"
    sensor = "hdl64e_kitti_odometry"
    patterns = ("*/*.png", "*.png")
    examples = ("drive_a/{index:06d}.png", "drive_b/{index:06d}.png")

    @staticmethod
    def sequence_of(relative: Path) -> str:
        """Name the folder of a file."""
        return relative.parent.as_posix()

    @staticmethod
    def recognises(path: Path) -> bool:
        """Tell whether a file begins as a 16-bit grey PNG of 64 rows."""
        try:
            _check_header(path)
        except ScanError:
            return False
        return True

    @staticmethod
    def read(path: Path, bad_points: BadPoints) -> Scan:
        """Read one image as points on the centres of its columns; ``bad_points`` has no effect, 0 is the only one."""
        range_m = torch.from_numpy(_pixels(path).astype(np.float32) / np.float32(_VALUES_PER_M))
        if not bool(range_m.any()):
            raise ScanError(f"no return in {path}", "a range in some pixel", "remove the file")
        image = RangeImage(range_m, range_m > 0, _rays(range_m.shape[1]))
        return replace(unproject(image), source=str(path))

    @staticmethod
    def write(path: Path, scan: Scan) -> None:
        """Write a scan as an image of 870 columns, as the Karlsruhe recordings have."""
        image = project(scan, load_sensor(RangeImageFiles.sensor).with_columns(870))
        values = (image.range_m * _VALUES_PER_M).round().clamp(max=65_535)
        Image.fromarray(values.numpy().astype(np.uint16)).save(path)


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
    size = (_check_header(path), _ROWS)  # before pixels are unpacked: a hostile header could ask for gigabytes
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path, formats=("PNG",)) as image:
            if (image.mode, image.size) != ("I;16", size):  # a later chunk can contradict the header
                raise ValueError(f"{image.mode} pixels, {image.size}")
            return np.array(image, dtype=np.uint16)
    except Exception as error:  # the decoder meets a damaged file with whatever its chunks make it stumble over
        raise ScanError(f"{path}, a damaged PNG ({error})", _FORMAT, "download it again, or remove it") from None


def _check_header(path: Path) -> int:
    """Return the number of columns that the header states."""
    try:
        if not path.is_file():
            raise ScanError(f"{path}, which is not a file", _FORMAT, "check the path")
        with path.open("rb") as file:
            header = file.read(26)
    except OSError as error:
        raise ScanError(f"{path}, which cannot be read ({error.strerror})", _FORMAT, "check the path") from None
    if len(header) < 26 or header[:8] != b"\x89PNG\r\n\x1a\n":
        raise ScanError(f"{path}, which is no PNG", _FORMAT, "convert the image, or remove the file")
    columns, rows, bits, colour = struct.unpack(">IIBB", header[16:26])
    if (rows, bits, colour) != (_ROWS, 16, 0) or not 1 <= columns <= _COLUMNS_AT_MOST:
        raise ScanError(
            f"{path}, a PNG of {rows} rows and {columns} columns with {bits} bits{'' if colour == 0 else ' in colour'}",
            _FORMAT,
            "give the images of a 64-beam sensor, or convert them",
        )
    return columns
