"""Columns of a file that may be the time of each point → the one that is, in seconds."""

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Bool, Float64, Num
from torch import Tensor

# Lower case. Velodyne's driver writes time, Ouster's t, Hesai's and RoboSense's timestamp, Livox's offset_time, LAS
# gps_time, Argoverse offset_ns.
TIME_NAMES = (
    "time",
    "time_s",
    "t",
    "timestamp",
    "timestamps",
    "time_stamp",
    "offset_time",
    "time_offset",
    "gps_time",
    "offset_ns",
)
_OF_WHOLE_NUMBERS, _OF_FRACTIONS = (1e-9, 1e-6, 1e-3, 1.0), (1.0, 1e-3, 1e-6, 1e-9)  # the likeliest unit first
_TURN_S = 0.02, 1.0  # that one revolution takes: 50 to 1 Hz


def point_times(
    named: Mapping[str, Num[np.ndarray, "n"]], good: Bool[Tensor, "n"]
) -> tuple[Float64[Tensor, "n"] | None, tuple[str, ...]]:
    """Return the time of each point in seconds, and a note where the unit was told by the values.

    Whole numbers are nanoseconds and others seconds, as drivers write them, unless these last shorter or longer than a
    revolution and another unit does not. A column of one value tells nothing.

    Args:
        named: columns by their plain names.
        good: whether a point is a return; the others have time 0 if theirs is no number.
    """
    for name in TIME_NAMES:
        if name not in named or not good.any():
            continue
        values = named[name].astype(f"{named[name].dtype.kind}8")  # units are larger than what fewer bits hold
        known = values[good.numpy()]
        if not np.isfinite(known).all() or not (known != known[0]).any():
            continue
        whole = values.dtype.kind in "iu"
        # Nanoseconds since 1970 take more digits than a double has; what was whole is divided as such.
        lasted = known.max().item() - known.min().item()
        units = _OF_WHOLE_NUMBERS if whole else _OF_FRACTIONS
        usual, fitting = units[0], [unit for unit in units if _TURN_S[0] <= lasted * unit <= _TURN_S[1]]
        unit = fitting[0] if fitting and usual not in fitting else usual
        per_s = round(1 / unit)
        times_s = values // per_s + values % per_s / per_s if whole else values * unit
        told = {1e-9: "nanoseconds", 1e-6: "microseconds", 1e-3: "milliseconds", 1.0: "seconds"}[unit]
        notes = (
            () if unit == usual else (f"{name} of each point taken as {told}, in which a revolution lasts as usual",)
        )
        times_s = np.where(good.numpy() | np.isfinite(times_s), times_s, 0)
        return torch.from_numpy(times_s.astype(np.float64)), notes
    return None, ()
