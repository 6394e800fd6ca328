"""Arrays, or named columns of points as files hold them → the parts of a scan."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence, Set
from typing import Literal, Required, TypeAlias, TypedDict, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Num
from torch import Tensor

from lidargrit.core.errors import ScanError, UnknownNameError, one_of
from lidargrit.scans.classes import notes_on_labels
from lidargrit.scans.file_rows import FileRows
from lidargrit.scans.point_times import TIME_NAMES, point_times
from lidargrit.scans.reflectance import REFLECTANCE_NAMES, choose_reflectance, floats

BadPoints = Literal["refuse", "drop"]
Values: TypeAlias = np.ndarray | Tensor | Sequence[float]
"""Numbers of every point."""

_RING = ("ring", "channel")  # lower case; CloudCompare puts "scalar_" before its names
_LABEL = ("label",)
_FILLED = ("filled",)
_ALIKE = re.compile("intens|reflect|remission|scalar.?field|laser|ring|channel|beam|layer")  # of names, not values
_LASERS = (16, 32, 40, 64, 80, 128, 256)  # that sensors have; the top ring may have no return, and not be in the file
_ONE_RING_AT_MOST_RAD = math.radians(5)  # that the elevations of a sensor with one ring may span
_LOST_AT_MOST_M = 0.5e-3  # of coordinates, in the median: that of points beyond 16 km
_RING_AT_MOST = 65_535  # 16 bits, as ROS drivers store it
_LABEL_AT_MOST = 2**32 - 1  # SemanticKITTI's: class and instance in 16 bits each


class ScanParts(TypedDict, total=False):
    """What a :class:`~lidargrit.scans.types.Scan` is made of, by the names of its fields."""

    points_xyz_m: Required[Float[Tensor, "n 3"]]
    reflectance: Float[Tensor, "n"] | None
    ring: Int[Tensor, "n"] | None
    label: Int[Tensor, "n"] | None
    filled: Bool[Tensor, "n"] | None
    point_time_s: Float[Tensor, "n"] | None
    full_scale: int
    notes: tuple[str, ...]
    rows: FileRows | None


def parts_of_columns(
    columns: Mapping[str, Num[np.ndarray, "n"]],
    source: str,
    bad_points: BadPoints,
    others: Iterable[str] = (),
    are_named: bool = True,
) -> ScanParts:
    """Return the parts of a scan in columns that are known by their names; others are left alone.

    Reflectance is divided by 1, 255 or 65535: the smallest that no value exceeds, and 255 for columns of 8 bits. Among
    fractions of 1, a few larger values are set to 1, with a note. Reflectance is left out, with a note, where it is
    none: of negative values or counts above 65535. Rings are counted from the top: where the file's rise with
    elevation, they are turned round. A ring that all points have is none.

    Args:
        columns: values of every point by their names.
        source: file or other origin of the columns, for messages.
        others: names of columns that were not read.
        are_named: whether the file itself has the names; where it has not, reflectance that is none shows another
            layout, and is refused.
    """
    named = {_plain(name): values for name, values in reversed(list(columns.items()))}
    if not {"x", "y", "z"} <= named.keys():
        there = ", ".join(map(ascii, list(columns)[:8])) or "none"
        raise ScanError(f"{source}, whose columns are {there[:120]}", "x, y and z among them", "rename its columns")
    points_xyz_m = torch.stack([floats(named[axis]) for axis in "xyz"], dim=1)
    _refuse_lost_digits([named[axis] for axis in "xyz"], points_xyz_m, source)
    ring, label = (_first(named, names) for names in (_RING, _LABEL))
    good = _are_returns(points_xyz_m)
    ring = None if ring is None else _whole(ring, good, _RING_AT_MOST, "ring", source)
    if ring is not None and _tells_rows(ring, points_xyz_m, good):
        _refuse_counts_from_1(ring[good], source)
        ring = _from_the_top(ring, points_xyz_m, good)
    else:
        ring = None
    reflectance, full_scale, notes = choose_reflectance(named, good, are_named)
    notes += _left_alone({*named, *map(_plain, others)})
    label = None if label is None else _whole(label, good, _LABEL_AT_MOST, "label", source)
    times_s, told = point_times(named, good)
    marks = _first(named, _FILLED)
    parts = ScanParts(
        points_xyz_m=points_xyz_m,
        reflectance=reflectance,
        ring=ring,
        label=label,
        filled=torch.from_numpy(marks == 1) if marks is not None and np.isin(marks, (0, 1)).all() else None,
        point_time_s=times_s,
        full_scale=full_scale,
        notes=(*notes, *notes_on_labels(label), *told),
        rows=FileRows(columns, np.arange(len(points_xyz_m))),
    )
    return treated_parts(parts, bad_points)


def columns_of_arrays(xyz: np.ndarray | Tensor, **values: Values | None) -> dict[str, np.ndarray]:
    """Return arrays, of NumPy or torch on any device, as named columns.

    Args:
        xyz: coordinates (n, 3), or (n, 4) with intensity.
        values: further numbers of every point by their names; None for what is not known.
    """
    points = _array(xyz)
    if points.ndim != 2 or points.shape[1] not in (3, 4):
        wanted = "(n, 3) with x, y and z in metres, or (n, 4) with intensity"
        raise ScanError(f"points of shape {points.shape}", wanted, "take these columns, e.g. points[:, :3]")
    columns: dict[str, np.ndarray] = dict(zip(["x", "y", "z", "intensity"], points.T, strict=False))
    for name, given in values.items():
        if given is not None:
            columns[name] = _array(given)
            if columns[name].shape != (len(points),):
                raise ScanError(f"{name} of shape {columns[name].shape}", f"({len(points)},), one a point", "fix it")
    return columns


def treated_parts(parts: ScanParts, bad_points: BadPoints) -> ScanParts:
    """Return the parts of a scan, of ``drop`` without the points that are no returns, which a note counts."""
    if bad_points not in get_args(BadPoints):
        raise UnknownNameError(f"bad_points={bad_points!r}", one_of(get_args(BadPoints)), "choose one")
    if bad_points == "refuse":
        return parts
    points_xyz_m, reflectance = parts["points_xyz_m"], parts.get("reflectance")
    kept = _are_returns(points_xyz_m)
    if reflectance is not None:
        kept &= ~reflectance.isnan()
    if bool(kept.all()):
        return parts
    told = f"{int((~kept).sum()):,} of {len(kept):,} points left out: NaN, infinite or at the origin"
    return {**parts, **selected(parts, kept), "notes": (*parts.get("notes", ()), told)}


def _are_returns(points_xyz_m: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
    return points_xyz_m.isfinite().all(dim=1) & (points_xyz_m != 0).any(dim=1)


def selected(parts: ScanParts, which: Tensor) -> ScanParts:
    """Return all that is known point by point, for those points that a mask or their numbers choose.

    Args:
        which: mask (n) or numbers (k) of the points.
    """
    rows, chosen = parts.get("rows"), ScanParts(points_xyz_m=parts["points_xyz_m"][which].contiguous())
    for name in ("reflectance", "ring", "label", "filled", "point_time_s"):
        if (values := parts.get(name)) is not None:
            chosen[name] = values[which].contiguous()
    if rows is not None:
        chosen["rows"] = FileRows(rows.columns, rows.of_point[which.numpy()])
    return chosen


def known_name(name: str) -> str:
    """Return the plain name of a column besides x, y and z that a scan has room for; "" if it has none."""
    return _plain(name) if _plain(name) in (*REFLECTANCE_NAMES, *_RING, *_LABEL, *_FILLED, *TIME_NAMES) else ""


def quantity_of(name: str) -> str:
    """Return what of a scan a column holds: x, y, z, reflectance, ring, label, filled or time; "" for nothing."""
    plain = _plain(name)
    kinds = {"reflectance": REFLECTANCE_NAMES, "ring": _RING, "label": _LABEL, "filled": _FILLED, "time": TIME_NAMES}
    return plain if plain in ("x", "y", "z") else next((kind for kind, names in kinds.items() if plain in names), "")


def _array(values: Values) -> np.ndarray:
    if isinstance(values, Tensor):
        values = values.detach().cpu()
        found = (values.float() if values.dtype == torch.bfloat16 else values).numpy()  # which NumPy does not know
    elif isinstance(values, np.ma.MaskedArray) and values.mask.any():
        found = np.ma.filled(values.astype(np.float64), np.nan)  # a masked point is none
    else:
        found = np.asarray(values)
    if found.dtype.kind not in "fiu":
        raise ScanError(f"values of type {found.dtype}", "numbers", "convert them, e.g. by .astype(np.float32)")
    return found


def _plain(name: str) -> str:
    return name.lower().removeprefix("scalar_")


def _refuse_lost_digits(exact: list[np.ndarray], points_xyz_m: Tensor, source: str) -> None:
    """Refuse coordinates that 32 bits do not keep, those of maps: every verb would move the points."""
    if all(values.dtype.itemsize <= 4 for values in exact) or not len(points_xyz_m):
        return
    with np.errstate(over="ignore", invalid="ignore"):
        kept = points_xyz_m.double().numpy()
        lost_m = np.abs(np.stack(exact, axis=1).astype(np.float64) - kept).max(axis=1)
    lost_m = lost_m[np.isfinite(lost_m)]
    if not len(lost_m) or (typical_m := float(np.median(lost_m))) <= _LOST_AT_MOST_M:
        return
    far_km = float(np.median(np.linalg.norm(kept[np.isfinite(kept).all(axis=1)], axis=1))) / 1000
    raise ScanError(
        f"coordinates of a map in {source} ({far_km:,.0f} km from the origin), which would move by {typical_m:.3f} m "
        f"in the median and {lost_m.max():.3f} m at most in the 32 bits that scans are kept in",
        "those of a sensor, seen from its place",
        "subtract the sensor's place from x, y and z",
    )


def _left_alone(named: Set[str]) -> tuple[str, ...]:
    """Return a note on columns that are left alone although a scan lacks what they may be."""
    missing = [name for name, names in (("intensity", REFLECTANCE_NAMES), ("ring", _RING)) if not named & {*names}]
    alike = [name for name in sorted(named) if not known_name(name) and _ALIKE.search(name)]
    if not missing or not alike:
        return ()
    what = f"{'a column' if len(alike) == 1 else 'columns'} {', '.join(map(ascii, alike[:3]))} left alone"
    return (f"{what}; rename what is {' or '.join(missing)} to that",)


def _first(named: Mapping[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray | None:
    return next((named[name] for name in names if name in named), None)


def _whole(values: np.ndarray, good: Tensor, at_most: int, what: str, source: str) -> Tensor:
    """Return whole numbers, 0 where the point is none."""
    values = np.where(good.numpy(), values, 0)
    # NaN and infinity equal no whole number, and the limits may be infinite as half precision.
    with np.errstate(over="ignore", invalid="ignore"):
        whole = bool(((values >= 0) & (values <= at_most) & (values % 1 == 0)).all())
    if not whole:
        raise ScanError(
            f"a {what} that is not whole or out of bounds in {source}", f"0 to {at_most:,}", "correct the file"
        )
    return torch.from_numpy(values.astype(np.int64))


def _tells_rows(ring: Tensor, points_xyz_m: Tensor, good: Tensor) -> bool:
    """Return whether a column of rings tells points apart: some drivers write 0 for all."""
    if not good.any() or (ring[good] != ring[good][0]).any():
        return True
    low, high = _elevation_rad(points_xyz_m[good]).aminmax()
    return float(high - low) < _ONE_RING_AT_MOST_RAD


def _refuse_counts_from_1(ring: Tensor, source: str) -> None:
    """Refuse rings from 1 to the number of lasers that a sensor has; in rows counted from 0 each would be off by 1."""
    if len(ring) and 1 <= int(ring.min()) < int(ring.max()) and int(ring.max()) in _LASERS:
        raise ScanError(
            f"rings from {int(ring.min())} to {int(ring.max())} in {source}, as if they were counted from 1",
            "rings counted from 0",
            "subtract 1 from each, or leave the column out",
        )


def _from_the_top(ring: Tensor, points_xyz_m: Tensor, good: Tensor) -> Tensor:
    """Return rings counted from the highest, whichever way round the file counts them."""
    centred = ring[good].double() - ring[good].double().mean()
    if not bool((centred * _elevation_rad(points_xyz_m[good])).sum() > 0):
        return ring
    highest = int(ring.max())
    lasers = next((count for count in _LASERS if highest < count), highest + 1)
    return torch.where(good, lasers - 1 - ring, 0)


def _elevation_rad(points_xyz_m: Tensor) -> Tensor:
    x, y, z = points_xyz_m.double().unbind(dim=1)
    return torch.atan2(z, torch.hypot(x, y))
