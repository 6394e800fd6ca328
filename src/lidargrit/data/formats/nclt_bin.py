"""NCLT's .bin (velodyne_sync): rows of x, y, z in steps of 5 mm, intensity and laser → :class:`Scan`."""

from pathlib import Path

import numpy as np
import torch

from lidargrit.core.errors import ScanError
from lidargrit.data.formats import POINTS_AT_MOST, BadPoints, ScanFormat, first_bytes, read_bytes, scan_of
from lidargrit.scans.types import Scan

_ROW = np.dtype([("xyz", "<u2", 3), ("intensity", "u1"), ("laser", "u1")])
_ROWS_TO_LOOK_AT = 4096
_STEP_M, _OFFSET_M = 0.005, -100.0
_LASERS, _LASERS_AT_LEAST = 32, 8  # of an HDL-32E, and those that have a return among the first points
_FARTHEST_M, _WITHIN = 100.0, 0.99
_FORMAT = "rows of x, y, z of 16 bits in steps of 5 mm, intensity and laser, 8 bytes a point"


class NcltBin(ScanFormat):
    """Revolutions of an HDL-32E as the North Campus Long-Term data set has them; lasers are in the order of firing.

    Such a file is told from others of its ending by its content: every eighth byte is one of 32 lasers.

    Source:
        Carlevaris-Bianco et al., University of Michigan North Campus long-term vision and lidar dataset, IJRR 2016, and
        the layout in its read_vel_sync.py.
    """

    title = "NCLT .bin (x, y, z of 16 bits, intensity, laser)"
    suffixes = (".bin",)
    reflectance = "0 to 255, divided by 255"
    frame = "x forward, y right, z down"

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether rows hold numbers of lasers at their end, and coordinates that an HDL-32E can see."""
        start = first_bytes(path, _ROW.itemsize * _ROWS_TO_LOOK_AT)
        if not start or path.stat().st_size % _ROW.itemsize:
            return False
        rows = np.frombuffer(start, _ROW)
        within = np.abs(rows["xyz"] * _STEP_M + _OFFSET_M) < _FARTHEST_M
        return (
            bool((rows["laser"] < _LASERS).all())
            and len(np.unique(rows["laser"])) >= _LASERS_AT_LEAST
            and float(within.mean()) > _WITHIN
        )

    @staticmethod
    def read(path: Path, index: int = 0, bad_points: BadPoints = "refuse") -> Scan:
        """Read the scan in a file."""
        data = read_bytes(path, POINTS_AT_MOST * _ROW.itemsize, _FORMAT)
        if not NcltBin.recognises(path):
            raise ScanError(f"{path}, which does not hold such rows", _FORMAT, "check what wrote it")
        rows = np.frombuffer(data, _ROW)
        xyz_m = (rows["xyz"] * _STEP_M + _OFFSET_M) * (1, -1, -1)  # the sensor's axes look to the right and down
        reflectance = torch.from_numpy((rows["intensity"] / 255).astype(np.float32))
        return scan_of(torch.from_numpy(xyz_m.astype(np.float32)), reflectance, None, str(path), bad_points)
