"""KITTI .bin: float32 rows x, y, z, reflectance ⇄ :class:`Scan`."""

from pathlib import Path

import numpy as np
import torch

from lidargrit.core.errors import ScanError
from lidargrit.data.formats import POINTS_AT_MOST, BadPoints, first_bytes, read_bytes, scan_of
from lidargrit.data.formats.shared.bare_rows import BareRowFormat, columns_by_name, rows_of, whole_rows, wide_row
from lidargrit.data.formats.shared.carla import right_handed
from lidargrit.data.formats.shared.filled import read_marks
from lidargrit.scans.types import Scan

_COLUMNS = ("x", "y", "z", "intensity")
_ROW_BYTES = 16
_PADDED_BYTES = 20  # of a row of OpenDWM
_ROWS_TO_LOOK_AT = 4096  # enough to tell reflectance from a coordinate
_LEAST_REFLECTANCE = 1e-12  # above 0; bytes of other numbers, such as NCLT's, give far less
_FORMAT = "float32 rows x, y, z, reflectance, 16 bytes a point"


class KittiBin(BareRowFormat):
    """Velodyne files as KITTI writes them, little-endian, points in the order in which they were fired.

    OpenDWM writes its samples of KITTI-360 as x, y, z and two zeros; they are read, too.

    Source:
        Geiger et al., Vision meets Robotics: the KITTI dataset, IJRR 2013.
    """

    title = "KITTI .bin (float32 x, y, z, reflectance)"
    suffixes = (".bin",)
    columns = _COLUMNS
    reflectance = "0 to 1, as it is"
    keeps = ("reflectance",)

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether rows of four, and no wider ones, end in a reflectance in [0, 1], or rows of five in zeros."""
        start = first_bytes(path, _ROW_BYTES * _ROWS_TO_LOOK_AT)
        if start and _is_padded(start, path.stat().st_size):
            return True
        if not start or path.stat().st_size % _ROW_BYTES:
            return False
        values = np.frombuffer(start, dtype="<f4")
        last = values[3::4]
        reflectance = (last == 0) | ((last >= _LEAST_REFLECTANCE) & (last <= 1))
        return bool(reflectance.all()) and not wide_row(values)

    @staticmethod
    def read(path: Path, index: int = 0, bad_points: BadPoints = "refuse") -> Scan:
        """Read the scan in a file."""
        data = read_bytes(path, POINTS_AT_MOST * _PADDED_BYTES, _FORMAT)
        if _is_padded(data, len(data)):
            padded = whole_rows(data, path, 5, _FORMAT)
            rows = rows_of(_COLUMNS, padded[:, :4])
            return scan_of(padded[:, :3], None, None, str(path), bad_points, rows=rows)
        if width := wide_row(np.frombuffer(data, "<f4", min(len(data) // 4, 4 * _ROWS_TO_LOOK_AT))):
            nuscenes = "if nuScenes wrote it, name it .pcd.bin; else " if width == 5 else ""
            cure = f"{nuscenes}keep x, y, z and reflectance from 0 to 1, or save named columns as .npz"
            raise ScanError(f"rows of {width} numbers in {path}", _FORMAT, cure)
        nuscenes = "if its rows have 5 columns, as nuScenes writes them, name it .pcd.bin; else "
        rows = whole_rows(data, path, len(_COLUMNS), _FORMAT, nuscenes if len(data) % 20 == 0 else "")
        scan = scan_of(
            rows[:, :3],
            rows[:, 3].contiguous(),
            None,
            str(path),
            bad_points,
            filled=read_marks(path, len(rows)),
            rows=rows_of(_COLUMNS, rows),
        )
        return right_handed(scan)

    @classmethod
    def columns_of(cls, scan: Scan) -> dict[str, np.ndarray]:
        """Return coordinates and reflectance, 0 if the scan has none."""
        reflectance = torch.zeros(len(scan)) if scan.reflectance is None else scan.reflectance
        return columns_by_name(_COLUMNS, torch.cat((scan.points_xyz_m, reflectance[:, None]), dim=1), scan.filled)


def _is_padded(start: bytes, size: int) -> bool:
    """Return whether each row has coordinates and two zeros, in the first bytes of a file of some size."""
    if size % _PADDED_BYTES:
        return False
    rows = np.frombuffer(start, "<f4", len(start) // _PADDED_BYTES * 5).reshape(-1, 5)
    return not (rows[:, 3:] != 0).any() and bool((rows[:, :3] != 0).any(axis=0).all())
