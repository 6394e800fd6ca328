"""Arrays in memory, of NumPy or torch → :class:`Scan`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
from torch import Tensor

from lidargrit.core.errors import ScanError
from lidargrit.data.formats import BadPoints
from lidargrit.data.formats.shared.columns import scan_of_columns
from lidargrit.scans.types import Scan

Values: TypeAlias = np.ndarray | Tensor | Sequence[float]
"""Numbers of every point."""
Points: TypeAlias = Scan | np.ndarray | Tensor
"""A scan, or coordinates of its points in metres as an array (n, 3), or (n, 4) with intensity."""

_SOURCE = Path("the points in memory")


def scan_from_points(
    xyz: np.ndarray | Tensor,
    intensity: Values | None = None,
    ring: Values | None = None,
    time: Values | None = None,
    label: Values | None = None,
    bad_points: BadPoints = "refuse",
) -> Scan:
    """Make a scan of arrays, of NumPy or torch on any device.

    Args:
        xyz: coordinates (n, 3) in metres in the sensor's frame, x forward, y left, z up; with intensity (n, 4).
        intensity: intensity or reflectance (n,), from 0 to 1, 255 or 65,535: the smallest that no value exceeds.
        ring: index of each point's laser (n,), counted from the top or from the bottom.
        time: time of each point (n,), which files that are written of the scan keep.
        label: class of each point (n,) by SemanticKITTI's numbers.
        bad_points: treatment of points that are no returns: ``refuse`` raises an error, ``drop`` removes points with
            NaN or infinite coordinates and points at the origin.

    Raises:
        ScanError: an array of another shape, or points that cannot be used; says what is wrong and what to do.

    Example:
        >>> import numpy as np
        >>> scan = scan_from_points(np.array([[10.0, 0.0, -1.0], [0.0, 5.0, -1.0]]), intensity=[12, 255])
        >>> len(scan), round(float(scan.reflectance[0]), 3)
        (2, 0.047)
    """
    points = _array(xyz)
    if points.ndim != 2 or points.shape[1] not in (3, 4):
        wanted = "(n, 3) with x, y and z in metres, or (n, 4) with intensity"
        raise ScanError(f"points of shape {points.shape}", wanted, "take these columns, e.g. points[:, :3]")
    columns = dict(zip("xyz", points.T, strict=False))
    if points.shape[1] == 4 and intensity is None:
        columns["intensity"] = points[:, 3]
    for name, values in (("intensity", intensity), ("ring", ring), ("time", time), ("label", label)):
        if values is not None:
            columns[name] = _array(values)
            if columns[name].shape != (len(points),):
                raise ScanError(f"{name} of shape {columns[name].shape}", f"({len(points)},), one a point", "fix it")
    return scan_of_columns(columns, _SOURCE, bad_points)


def scan_of(points: Points) -> Scan:
    """Return a scan as it is, and points in an array as a scan."""
    if isinstance(points, Scan):
        return points
    if isinstance(points, (np.ndarray, Tensor)):
        return scan_from_points(points)
    wanted = "a Scan, or its points as a NumPy array or torch tensor"
    raise ScanError(f"points as {type(points).__name__}", wanted, "np.asarray(points), or lidargrit.load_scan(path)")


def _array(values: Values) -> np.ndarray:
    found = values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)
    if found.dtype.kind not in "fiu":
        raise ScanError(f"values of type {found.dtype}", "numbers", "convert them, e.g. by .astype(np.float32)")
    return found
