"""A message sensor_msgs/PointCloud2 of ROS → its named columns."""

from typing import Any

import numpy as np

from lidargrit.data.formats import POINTS_AT_MOST

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # PointField's datatype
_PLAUSIBLE_M = 1e-3, 1e6  # a coordinate that is read in the wrong byte order is seldom in between
_FEW, _MOST = 0.5, 0.9  # shares of coordinates that tell the byte order; in the wrong one it is 0.12


def columns_of_cloud(cloud: Any) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """Return the named columns of a PointCloud2, and notes on what its header says wrongly.

    A field of several numbers a point is left alone, and so is one that lies beyond the point; of two of one name the
    first counts. ``row_step`` tells where rows begin, if there are several; where they cannot begin there, points
    follow one another without gaps.
    """
    notes, fields = [], {}
    size = int(cloud.point_step)
    if not int(cloud.width) * int(cloud.height):  # some drivers send a first cloud without fields, too
        return {axis: np.empty(0, np.float32) for axis in "xyz"}, ()
    for each in cloud.fields:
        if each.count > 1 or each.datatype not in _NUMBERS or each.name in fields:
            continue
        if each.offset + int(_NUMBERS[each.datatype][1]) > size:
            notes.append(f"field {ascii(each.name)[:40]} left out: it lies beyond the {size} bytes of a point")
        else:
            fields[each.name] = (_NUMBERS[each.datatype], int(each.offset))
    points = _points(cloud, size)
    order, note = _byte_order(points, fields, bool(cloud.is_bigendian))
    columns = {name: _column(points, order + kind, offset) for name, (kind, offset) in fields.items()}
    return columns, (*notes, *note)


def _points(cloud: Any, size: int) -> np.ndarray:
    """Return the bytes (n, size) of each point."""
    data = np.ascontiguousarray(cloud.data, dtype=np.uint8)
    width, height, row = int(cloud.width), int(cloud.height), int(cloud.row_step)
    if width * height > POINTS_AT_MOST or width * height * size > len(data):
        raise ValueError(f"{width}x{height} points of {size} bytes in {len(data)} bytes")
    last = row * (height - 1)  # beginning of a row that often ends without the gap that the others have
    step = row if row > width * size and last + width * size <= len(data) else width * size
    return np.ndarray((height, width, size), np.uint8, data, strides=(step, size, 1)).reshape(-1, size)


def _column(points: np.ndarray, kind: str, offset: int) -> np.ndarray:
    size = np.dtype(kind).itemsize
    return np.ascontiguousarray(points[:, offset : offset + size]).view(kind).reshape(-1)


def _byte_order(points: np.ndarray, fields: dict[str, tuple[str, int]], is_big: bool) -> tuple[str, tuple[str, ...]]:
    """Return numpy's sign for the byte order: what the message says, unless only the other gives coordinates."""
    said, other = (">", "<") if is_big else ("<", ">")
    axes = [fields[axis] for axis in "xyz" if fields.get(axis, ("", 0))[0][:1] == "f"]
    if not axes or not len(points):
        return said, ()
    as_said, as_other = (
        np.mean([_plausible(_column(points, order + kind, offset)) for kind, offset in axes]) for order in (said, other)
    )
    if as_said >= _FEW or as_other <= _MOST:
        return said, ()
    return other, (f"bytes read as {'little' if is_big else 'big'}-endian, as only so they are coordinates",)


def _plausible(values: np.ndarray) -> float:
    """Return the share of numbers, placeholders left out, that may be coordinates in metres."""
    with np.errstate(invalid="ignore", over="ignore"):
        size = np.abs(values.astype(np.float64))
        known = np.isfinite(size) & (size != 0)
        within = (size >= _PLAUSIBLE_M[0]) & (size <= _PLAUSIBLE_M[1])
    return float(within[known].mean()) if known.any() else 0.0
