"""The order in which a pixel decoder generates pixels, from coarse to fine: size of a cell → phases, neighbours."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from lidargrit.errors import ConfigError

_ORDER = ((0, 0), (1, 1), (0, 1), (1, 0))  # within 2x2 pixels of a lattice: a corner, its opposite, then the others
_PLUS, _DIAGONAL = ((-1, 0), (0, -1)), ((-1, -1), (-1, 1))  # one neighbour of each pair; the other lies opposite


class Phase(NamedTuple):
    """Pixels that are generated together: one of every 2x2 pixels of a lattice.

    Args:
        spacing: distance between two pixels of the lattice, in rows and in columns of the image.
        row: row of the pixel within its 2x2 pixels, 0 or 1.
        column: column of the pixel within its 2x2 pixels, 0 or 1.
    """

    spacing: int
    row: int
    column: int

    @property
    def rank(self) -> int:
        """Number of pixels of the 2x2 that are generated before this one."""
        return _ORDER.index((self.row, self.column))

    @property
    def pixels(self) -> tuple[slice, slice]:
        """Rows and columns of the phase's pixels in the image."""
        step = 2 * self.spacing
        return slice(self.row * self.spacing, None, step), slice(self.column * self.spacing, None, step)


def phases_of(coarsest_cell: int) -> list[Phase]:
    """Return every phase in order: one pixel of each coarsest cell, then three phases for each halving of the distance.

    Args:
        coarsest_cell: rows and columns of the cells of which the first phase generates one pixel each; a power of 2.
    """
    if coarsest_cell < 2 or coarsest_cell & (coarsest_cell - 1):
        raise ConfigError(f"coarsest_cell={coarsest_cell}", "a power of 2, at least 2", "e.g. 8")
    phases = [Phase(coarsest_cell // 2, 0, 0)]
    spacing = coarsest_cell // 2
    while spacing:
        phases += [Phase(spacing, row, column) for row, column in _ORDER[1:]]
        spacing //= 2
    return phases


def generated_before(phase: Phase) -> Bool[Tensor, "4"]:
    """Return which of the 2x2 pixels, row by row, are generated before a phase's."""
    before = torch.zeros(2, 2, dtype=torch.bool)
    for row, column in _ORDER[: phase.rank]:
        before[row, column] = True
    return before.flatten()


def cells_of(maps: Float[Tensor, "B C H W"], spacing: int) -> Float[Tensor, "B C*4 h w"]:
    """Return a lattice of the image with every 2x2 of its pixels as channels of one cell."""
    return F.pixel_unshuffle(maps[..., ::spacing, ::spacing], 2)


class Neighbours(NamedTuple):
    """The pixels around those of a phase that were generated before: two pairs that lie opposite each other.

    Args:
        values: values of the first and the second pair; each pair holds a neighbour and its opposite.
        known: True where a neighbour is in the image and holds a value.
        rows_apart: two flags, one a pair: True where its two neighbours lie in different rows.
    """

    values: Float[Tensor, "B 2 2 h w"]
    known: Bool[Tensor, "B 2 2 h w"]
    rows_apart: tuple[bool, bool]


def neighbours_of(phase: Phase, values: Float[Tensor, "B H W"], known: Bool[Tensor, "B H W"]) -> Neighbours:
    """Return the nearest pixels of earlier phases: above, below, left and right, or at the corners.

    The first phase has none. Columns wrap around; rows beyond the image are not known.
    """
    step = slice(None, None, phase.spacing)
    values, known = values[..., step, step], known[..., step, step]
    values = F.pad(torch.cat((values[..., -1:], values, values[..., :1]), -1), (0, 0, 1, 1))
    known = F.pad(torch.cat((known[..., -1:], known, known[..., :1]), -1), (0, 0, 1, 1))
    height, width = (known.shape[-2] - 2) // 2, (known.shape[-1] - 2) // 2
    pairs = _DIAGONAL if phase.rank == 1 else _PLUS
    found_values, found_known = [], []
    for down, right in pairs:
        for sign in (1, -1):
            top, left = 1 + phase.row + sign * down, 1 + phase.column + sign * right
            part = (..., slice(top, top + 2 * height, 2), slice(left, left + 2 * width, 2))
            found_values.append(values[part])
            found_known.append(known[part] if phase.rank else torch.zeros_like(known[part]))
    rows_apart = (pairs[0][0] != 0, pairs[1][0] != 0)
    stacked = torch.stack(found_values, 1).unflatten(1, (2, 2)), torch.stack(found_known, 1).unflatten(1, (2, 2))
    return Neighbours(*stacked, rows_apart)


def at_phases(values: Shaped[Tensor, "B H W"], phases: list[Phase]) -> Shaped[Tensor, "P B h w"]:
    """Return the pixels of phases of one spacing."""
    return torch.stack([values[(..., *phase.pixels)] for phase in phases])


def join_phases(coarser: Float[Tensor, "B h w"] | None, values: Float[Tensor, "P B h w"]) -> Float[Tensor, "B H W"]:
    """Return a lattice's values, from those of the coarser lattice and those of all phases of its own spacing.

    Args:
        coarser: values of the next coarser lattice; None for the coarsest spacing, which has four phases.
        values: values of three phases, or of four, in their order.
    """
    corner = values[0] if coarser is None else coarser
    opposite, right, below = values[-3:]
    return F.pixel_shuffle(torch.stack((corner, right, below, opposite), 1), 2)[:, 0]
