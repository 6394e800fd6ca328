"""nuScenes .pcd.bin: float32 rows x, y, z, intensity, laser of an HDL-32E ⇄ :class:`Scan` with a ring per point."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32

from lidargrit.core.errors import OutputError, ScanError
from lidargrit.data.formats import POINTS_AT_MOST, BadPoints, first_bytes, read_bytes, scan_of
from lidargrit.data.formats.shared.bare_rows import BareRowFormat, columns_by_name, rows_of, whole_rows
from lidargrit.data.formats.shared.filled import read_marks
from lidargrit.scans.types import Scan

_COLUMNS = ("x", "y", "z", "intensity", "ring")
_ROW_BYTES = 20
_LASERS = 32
_NEAR_M = 1.0  # a beam that did not return is stored as a point where the car has been, nearer than this
_ROWS_TO_LOOK_AT = 4096  # enough to tell laser numbers from coordinates
_FORMAT = "float32 rows x, y, z, intensity, laser (0 to 31), 20 bytes a point"


class NuscenesBin(BareRowFormat):
    """LIDAR_TOP of nuScenes: little-endian, 32 points for each firing, moved to where the car was at the end.

    Every beam has a row, also one that did not return: it is stored at the sensor's origin and then moved with the car,
    up to a metre. Such points, and the car's own roof, are left out: points nearer than 1 m. nuScenes numbers the
    lasers from the lowest; ``ring`` counts from the highest. The motion correction moves near points of one ring up and
    down by a degree, so that ``--set data.projection=unfolding`` (rows by ring) assigns rows better than elevation.
    Generators such as OpenDWM write the same rows with 0 for every laser: such points have no ring.

    Source:
        Caesar et al., nuScenes, CVPR 2020; its tools (nutonomy/nuscenes-devkit) leave out points nearer than 1 m too.
    """

    title = "nuScenes .pcd.bin (float32 x, y, z, intensity, laser)"
    suffixes = (".pcd.bin",)
    columns = _COLUMNS
    reflectance = "intensity 0 to 255, divided by 255"
    frame = "x right, y forward, z up"
    sensor = "hdl32e"
    keeps = ("reflectance", "ring")

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether rows of five end in the number of a laser."""
        start = first_bytes(path, _ROW_BYTES * _ROWS_TO_LOOK_AT)
        if not start or path.stat().st_size % _ROW_BYTES:
            return False
        return _are_lasers(np.frombuffer(start, dtype="<f4")[4::5])

    @staticmethod
    def read(path: Path, index: int = 0, bad_points: BadPoints = "refuse") -> Scan:
        """Read the scan in a file."""
        data = read_bytes(path, POINTS_AT_MOST * _ROW_BYTES, _FORMAT)
        kitti = "if its rows are x, y, z, reflectance, as KITTI writes them, name it .bin; else "
        rows = whole_rows(data, path, len(_COLUMNS), _FORMAT, kitti if len(data) % 16 == 0 else "")
        if not _are_lasers(rows[:, 4].numpy()):
            raise ScanError(f"laser numbers other than 0 to 31 in {path}", _FORMAT, "check the layout of its rows")
        marks = read_marks(path, len(rows))
        far = ~(rows[:, :3].norm(dim=1) < _NEAR_M)  # NaN stays, to be refused or dropped
        x_right, y_forward, z, intensity, laser = (column[far] for column in rows.unbind(1))
        points_xyz_m = torch.stack((y_forward, -x_right, z), dim=1)
        return scan_of(
            points_xyz_m,
            intensity / 255,
            _LASERS - 1 - laser.long() if bool(laser.any()) else None,
            str(path),
            bad_points,
            filled=None if marks is None else marks[far],
            rows=rows_of(_COLUMNS, rows, far),
        )

    @classmethod
    def columns_of(cls, scan: Scan) -> dict[str, np.ndarray]:
        """Return the columns of a scan of 32 rings in the axes of the file, intensity 0 if it has no reflectance."""
        if scan.ring is None or not 0 <= int(scan.ring.min()) <= int(scan.ring.max()) < _LASERS:
            raise OutputError(
                f"{scan.source}, whose points have {'no' if scan.ring is None else 'other'} rings",
                "rings from 0 to 31, those of an HDL-32E",
                "choose another format, such as bin or ply",
            )
        x, y, z = scan.points_xyz_m.unbind(1)
        reflectance = torch.zeros(len(scan)) if scan.reflectance is None else scan.reflectance
        rows = torch.stack((-y, x, z, (255 * reflectance).round(), (_LASERS - 1 - scan.ring).float()), dim=1)
        return columns_by_name(_COLUMNS, rows, scan.filled)


def _are_lasers(numbers: Float32[np.ndarray, "n"]) -> bool:
    return bool(np.isin(numbers, np.arange(_LASERS, dtype=np.float32)).all())
