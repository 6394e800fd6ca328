"""Columns of a file that may be reflectance → the one that is, as values from 0 to 1."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Num
from torch import Tensor

# Lower case. Where a file has several, the first counts that tells anything: reflectivity is calibrated where intensity
# is not (Ouster), but drivers write it as 0 where they do not compute it. Open3D's tensor clouds say "intensities".
REFLECTANCE_NAMES = ("reflectance", "reflectivity", "intensity", "remission", "intensities", "i")
_FULL_SCALES = (1, 255, 65_535)
_FRACTIONS_TELL = 10  # so many between 0 and 1 to each value above: 0 to 1 with a few too high, and no dark 0 to 255
_ABOUT_1 = 1.05  # of reflectance from 0 to 1 that a calibration took a little beyond
_A_LITTLE_BELOW_0 = 0.05  # of the full scale, which a calibration does as well; decibels go far below


class Reflectance(NamedTuple):
    """Reflectance of a file's points.

    Args:
        values: reflectance in [0, 1] (n,), unless the file's values are no numbers; None if there is none.
        full_scale: number that it was divided by if its values told that; 0 otherwise.
        notes: sentences on columns that were left out, and on values that were too high.
    """

    values: Tensor | None
    full_scale: int = 0
    notes: tuple[str, ...] = ()


def choose_reflectance(
    named: Mapping[str, Num[np.ndarray, "n"]], good: Bool[Tensor, "n"], may_leave_out: bool = True
) -> Reflectance:
    """Choose among the columns that are called like reflectance.

    Args:
        named: columns by their plain names.
        good: whether a point is a return; others do not tell.
        may_leave_out: whether values that are no reflectance are left out, and not kept to be refused.
    """
    usable, notes = [], []
    for name in (name for name in REFLECTANCE_NAMES if name in named):
        known = _known(named[name], good)
        if may_leave_out and (wrong := _why_none(known)):
            notes.append(
                f"{name} of {known.min():g} to {known.max():g} left out: {wrong}; scale it to 0 to 1 to keep it"
            )
        else:
            usable.append((name, bool(len(known) and (known != known[0]).any())))
    # A column of one value beside one with several tells nothing, and alone is what the file says.
    chosen = next((name for name, varies in usable if varies), usable[0][0] if usable else "")
    if not chosen:
        return Reflectance(None, 0, tuple(notes))
    known = _known(named[chosen], good)
    notes = [*([] if dict(usable)[chosen] else notes), *_above_1(chosen, known)]
    return Reflectance(*_to_unit(named[chosen], known), tuple(notes))


def floats(values: np.ndarray) -> Tensor:
    """Return numbers in 32 bits; a double beyond these becomes infinite, and is refused as such."""
    with np.errstate(over="ignore", invalid="ignore"):
        return torch.from_numpy(values.astype(np.float32))


def _known(values: np.ndarray, good: Tensor) -> np.ndarray:
    """Return the finite values of those points that are returns."""
    kept = floats(values[good.numpy()]).numpy()
    return kept[np.isfinite(kept)]


def _why_none(known: np.ndarray) -> str:
    """Return why values are no reflectance; "" if they are."""
    if not len(known):
        return ""
    full_scale = _full_scale(known)
    if float(known.min()) < -_A_LITTLE_BELOW_0 * (full_scale or 1):
        return "negative values, such as decibels, are no reflectance"
    return "" if full_scale else f"counts above {_FULL_SCALES[-1]:,} have no full scale that we know"


def _above_1(name: str, known: np.ndarray) -> tuple[str, ...]:
    """Return a note on values above 1 among reflectance from 0 to 1."""
    above = int(np.count_nonzero(known > _ABOUT_1))
    if not above or _full_scale(known) != 1:
        return ()
    return (
        f"{above:,} of {len(known):,} values of {name} set to 1, of up to {known.max():g}: most are fractions of 1",
    )


def _to_unit(reflectance: np.ndarray, known: np.ndarray) -> tuple[Tensor, int]:
    """Return reflectance from 0 to 1, and its full scale if the known values told that; 0 otherwise."""
    values = floats(reflectance)
    if reflectance.dtype == np.uint8:
        return values / 255, 0
    full_scale = _full_scale(known)
    values = values / (full_scale or 1)
    values = torch.where((values < 0) & (values >= -_A_LITTLE_BELOW_0), 0, values)
    if full_scale:
        values = torch.where(values.isinf(), values, values.clamp(max=1))
    return values, full_scale if (known > 0).any() else 0  # 0 is of any scale


def _full_scale(known: np.ndarray) -> int:
    """Return the number that known values are of; 0 if they are too high for any."""
    above, fractions = np.count_nonzero(known > _ABOUT_1), np.count_nonzero((known > 0) & (known < 1))
    if above * _FRACTIONS_TELL <= fractions:
        return 1
    return next((scale for scale in _FULL_SCALES if known.max() <= scale), 0)
