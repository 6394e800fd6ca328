"""float32 rows x, y, z without reflectance, also named .bin ⇄ :class:`Scan`."""

from pathlib import Path

import numpy as np

from lidargrit.core.errors import OutputError, ScanError
from lidargrit.data.formats import POINTS_AT_MOST, BadPoints, first_bytes, read_bytes, scan_of
from lidargrit.data.formats.shared.bare_rows import BareRowFormat, columns_by_name, row_width, rows_of, whole_rows
from lidargrit.data.formats.shared.filled import read_marks
from lidargrit.scans.types import Scan

_COLUMNS = ("x", "y", "z")
_ROW_BYTES = 12
_ROWS_TO_LOOK_AT = 4096  # enough to see after how many values a file resembles itself
_FARTHEST_M = 1000.0  # no lidar of a car sees farther; bytes that are no coordinates mostly are huge as float32
_FORMAT = "float32 rows x, y, z, 12 bytes a point"


class XyzBin(BareRowFormat):
    """Bare coordinates, little-endian, as some programs write KITTI's scans.

    Such a file is told from KITTI's, which has the same ending, by its content: after as many values as a point has, a
    file resembles itself most.
    """

    title = "bare .bin (float32 x, y, z)"
    suffixes = (".bin",)
    columns = _COLUMNS
    reflectance = "none"
    keeps = ()

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether a file holds coordinates that resemble themselves after three values."""
        start = first_bytes(path, _ROW_BYTES * _ROWS_TO_LOOK_AT)
        if not start or path.stat().st_size % _ROW_BYTES:
            return False
        values = np.frombuffer(start, dtype="<f4")
        values = np.where(np.isnan(values), 0, values)  # placeholders for no return
        return bool((np.abs(values) <= _FARTHEST_M).all()) and row_width(values) == 3

    @staticmethod
    def read(path: Path, index: int = 0, bad_points: BadPoints = "refuse") -> Scan:
        """Read the scan in a file."""
        data = read_bytes(path, POINTS_AT_MOST * _ROW_BYTES, _FORMAT)
        rows = whole_rows(data, path, len(_COLUMNS), _FORMAT)
        farthest_m = float(rows.nan_to_num(0.0, 0.0, 0.0).abs().max())
        if farthest_m > _FARTHEST_M:
            raise ScanError(f"a coordinate of {farthest_m:g} m in {path}", _FORMAT, "check the layout of its rows")
        marks = read_marks(path, len(rows))
        return scan_of(rows, None, None, str(path), bad_points, filled=marks, rows=rows_of(_COLUMNS, rows))

    @classmethod
    def columns_of(cls, scan: Scan) -> dict[str, np.ndarray]:
        """Return the coordinates of a scan."""
        farthest_m = float(scan.points_xyz_m.abs().max())
        if farthest_m > _FARTHEST_M:
            what = f"a coordinate of {farthest_m:g} m in {scan.source}, to write as {cls.title}"
            raise OutputError(what, f"at most {_FARTHEST_M:g} m", "choose another format, such as ply")
        return columns_by_name(_COLUMNS, scan.points_xyz_m, scan.filled)
