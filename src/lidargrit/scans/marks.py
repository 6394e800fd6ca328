"""Scans with a point on every surface: which surfaces return, and how bright → one number, stored as reflectance.

A surface that does not return has 0, and one that returns 0.5 + reflectance / 2. Readings of 0, which sensors do give,
stay distinct from lost returns, and ordinary scans, whose readings below 0.5 are many, cannot be taken for such scans.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

WORDS = "a reflectance of 0.5 + half of what is read for a return (1 if it is not known), and of 0 for none"
_LEAST = 0.5  # mark of a return whose reflectance is 0
_ROUNDING = 0.005  # a prepared scan rounds reflectance to 1 / 255


class Marked(NamedTuple):
    """Marks of surfaces, read.

    Args:
        returned: True where a surface returns.
        reflectance: reflectance of what returns, in [0, 1]; 0 elsewhere.
        is_clear: whether every mark is that of a return or of none.
        has_reflectance: whether the marks tell reflectance; 1 for each return tells nothing.
    """

    returned: Bool[Tensor, "*B H W"]
    reflectance: Float[Tensor, "*B H W"]
    is_clear: bool
    has_reflectance: bool


def mark(returned: Bool[Tensor, "*B H W"], reflectance: Float[Tensor, "*B H W"]) -> Float[Tensor, "*B H W"]:
    """Return the marks of surfaces.

    Args:
        returned: True where a surface returns.
        reflectance: reflectance of what returns, in [0, 1].
    """
    return torch.where(returned, _LEAST + (1 - _LEAST) * reflectance, 0.0)


def read_marks(marks: Float[Tensor, "*B H W"]) -> Marked:
    """Return which surfaces return, and their reflectance."""
    returned = marks > _LEAST - _ROUNDING
    reflectance = torch.where(returned, (marks - _LEAST) / (1 - _LEAST), 0.0).clamp(0, 1)
    is_clear = not bool((~returned & (marks > _ROUNDING)).any())
    has_reflectance = bool((returned & (marks < 1 - _ROUNDING)).any())
    return Marked(returned, reflectance, is_clear, has_reflectance)
