"""Points in polar coordinates: :class:`Scan` → range, elevation and azimuth of every point."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from lidargrit.core.errors import ScanError
from lidargrit.scans.projection.frame import other_frame
from lidargrit.scans.types import Scan

NOISE_RANGE_M = 1.0  # nearer points are the car that carries the sensor, or placeholders: their angles mean little
_SECTORS, _SECTORS_AT_LEAST = 36, 27  # of 10 degrees: a camera's crop fills a quarter of them, a revolution nearly all
_POINTS_AT_LEAST = 200  # fewer show no rings


@dataclass(frozen=True, eq=False)
class Points:
    """The points of one scan in the order of its file, without those too near to have an angle.

    Args:
        range_m: distance of every point from the origin, in metres.
        elevation_deg: elevation of every point; up is positive.
        azimuth_deg: azimuth of every point, counter-clockwise from +x, in [-180, 180].
        ring: ring number of every point in the file; None if the file has none.
        index: index of every point in the file, where points that are left out here count, too.
        num_in_file: number of points in the file, those left out here included.
    """

    range_m: Float64[np.ndarray, "n"]
    elevation_deg: Float64[np.ndarray, "n"]
    azimuth_deg: Float64[np.ndarray, "n"]
    ring: Int64[np.ndarray, "n"] | None
    index: Int64[np.ndarray, "n"]
    num_in_file: int

    def __len__(self) -> int:
        return len(self.range_m)

    @classmethod
    def of_scan(cls, scan: Scan) -> "Points":
        """Return the points of a scan, or refuse one that cannot show its sensor."""
        if frame := other_frame(scan):
            raise frame
        x, y, z = scan.points_xyz_m.double().numpy().T
        flat = np.hypot(x, y)
        range_m = np.hypot(flat, z)
        index = np.flatnonzero(range_m > NOISE_RANGE_M)
        azimuth_deg = np.degrees(np.arctan2(y[index], x[index]))
        sectors = len(np.unique(np.floor(azimuth_deg * (_SECTORS / 360))))
        if len(index) < _POINTS_AT_LEAST:
            raise ScanError(
                f"{len(index)} points beyond {NOISE_RANGE_M:g} m in {scan.source}",
                f"at least {_POINTS_AT_LEAST}",
                "use scans with more points, in metres",
            )
        if sectors < _SECTORS_AT_LEAST:
            raise ScanError(
                f"points in {sectors * 360 // _SECTORS} of 360 degrees of azimuth, in {scan.source}",
                "a full revolution in the sensor's own frame",
                "use uncropped scans",
            )
        ring = None if scan.ring is None else scan.ring.numpy().astype(np.int64)[index]
        elevation_deg = np.degrees(np.arctan2(z[index], flat[index]))
        return cls(range_m[index], elevation_deg, azimuth_deg, ring, index, len(scan))
