"""The order in which a pixel decoder generates pixels, from coarse to fine: size of a cell → phases, neighbours."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from lidargrit.core.errors import ConfigError

_BOTH = ((0, 0), (1, 1), (0, 1), (1, 0))  # of 2x2 pixels of a lattice: a corner, its opposite, then the others
_COLUMNS = ((0, 0), (1, 0), (0, 1), (1, 1))  # where whole columns are known: the next column, its even rows first
_ROWS = ((0, 0), (0, 1), (1, 0), (1, 1))  # where whole rows are known: the next row, its even columns first
_VERTICAL, _HORIZONTAL, _FALLING, _RISING = (-1, 0), (0, -1), (-1, -1), (-1, 1)  # one neighbour; the other is opposite


class Lattice(NamedTuple):
    """Pixels at equal distances, of which some are known; phases generate the others.

    Args:
        rows: distance between two pixels of the lattice, in rows of the image.
        columns: distance between two pixels of the lattice, in columns of the image.
        known: pixels that are generated before its phases: one corner of every 2x2, or every second column or row.
    """

    rows: int
    columns: int
    known: Literal["corners", "columns", "rows"] = "corners"

    @property
    def order(self) -> tuple[tuple[int, int], ...]:
        """Rows and columns within 2x2 pixels, in the order in which they are generated."""
        return {"corners": _BOTH, "columns": _COLUMNS, "rows": _ROWS}[self.known]

    @property
    def area(self) -> int:
        """Pixels of the image for each of the lattice."""
        return self.rows * self.columns

    @property
    def pixels(self) -> tuple[slice, slice]:
        """Rows and columns of the lattice's pixels in the image."""
        return slice(None, None, self.rows), slice(None, None, self.columns)

    @property
    def name(self) -> str:
        """Name of the lattice's network."""
        square = self.rows == self.columns and self.known == "corners"
        return str(self.rows) if square else f"{self.rows}x{self.columns}"


class Phase(NamedTuple):
    """Pixels that are generated together: one of every 2x2 pixels of a lattice.

    Args:
        lattice: lattice whose pixels they are.
        row: row of the pixel within its 2x2 pixels, 0 or 1.
        column: column of the pixel within its 2x2 pixels, 0 or 1.
    """

    lattice: Lattice
    row: int
    column: int

    @property
    def rank(self) -> int:
        """Number of pixels of the 2x2 that are generated before this one."""
        return self.lattice.order.index((self.row, self.column))

    @property
    def pixels(self) -> tuple[slice, slice]:
        """Rows and columns of the phase's pixels in the image."""
        rows, columns = self.lattice.rows, self.lattice.columns
        return slice(self.row * rows, None, 2 * rows), slice(self.column * columns, None, 2 * columns)

    @property
    def pairs(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Rows and columns, from a pixel to one neighbour of each of two pairs that are generated before it."""
        if self.lattice.known != "corners":
            both = (_HORIZONTAL, _VERTICAL) if self.lattice.known == "columns" else (_VERTICAL, _HORIZONTAL)
            return (both[0], _FALLING) if self.rank == 2 else both
        return (_FALLING, _RISING) if self.rank == 1 else (_VERTICAL, _HORIZONTAL)

    @property
    def neighbours(self) -> tuple[tuple[int, int], ...]:
        """Rows and columns from a pixel to its four neighbours: those of the first pair, then those of the second."""
        return tuple((sign * down, sign * right) for down, right in self.pairs for sign in (1, -1))

    @property
    def corners_known(self) -> bool:
        """Whether the pixels one row and one column away in every direction are generated before this one."""
        return self.rank == 1 or self.lattice.known != "corners"


def phases_of(coarsest_cell: int, column_halvings: int = 0, row_halvings: int = 0) -> list[Phase]:
    """Return every phase in order.

    First comes one pixel of each coarsest cell, then three phases for each halving of both distances, and at last two
    for each halving of one of them alone.

    Args:
        coarsest_cell: shorter side of the cells of which the first phase generates one pixel each; a power of 2.
        column_halvings: number of halvings of the distance between columns alone, in two phases each, that come last;
            the cells have as many columns as rows, times 2 for each.
        row_halvings: number of halvings of the distance between rows alone, likewise: the cells have as many rows as
            columns, times 2 for each. It is 0 if ``column_halvings`` is not.
    """
    if coarsest_cell < 2 or coarsest_cell & (coarsest_cell - 1):
        raise ConfigError(f"coarsest_cell={coarsest_cell}", "a power of 2, at least 2", "e.g. 8")
    if column_halvings and row_halvings:
        raise ConfigError(
            f"column_halvings={column_halvings}, row_halvings={row_halvings}", "one of them 0", "set one of them to 0"
        )
    spacing, higher, wider = coarsest_cell // 2, 2**row_halvings, 2**column_halvings
    phases = [Phase(Lattice(spacing * higher, spacing * wider), 0, 0)]
    while spacing:
        lattice = Lattice(spacing * higher, spacing * wider)
        phases += [Phase(lattice, row, column) for row, column in lattice.order[1:]]
        spacing //= 2
    known: Literal["columns", "rows"] = "columns" if wider > 1 else "rows"
    while wider > 1 or higher > 1:
        higher, wider = max(higher // 2, 1), max(wider // 2, 1)
        lattice = Lattice(higher, wider, known)
        phases += [Phase(lattice, row, column) for row, column in lattice.order[2:]]
    return phases


def completed_lattices(phases: list[Phase]) -> list[tuple[Lattice, int]]:
    """Return the lattices from coarse to fine, each with the number of phases after which all its pixels are generated.

    The first one has a pixel in every coarsest cell, those of the first phase; it is the lattice of no phase.
    """
    coarsest = phases[0].lattice
    ends = {phase.lattice: number for number, phase in enumerate(phases, start=1)}
    return [(Lattice(2 * coarsest.rows, 2 * coarsest.columns), 1), *ends.items()]


def one_of_phases(phases: list[Phase], rng: torch.Generator) -> list[Phase]:
    """Return a random phase of one lattice, which stands for all of them in training.

    Args:
        rng: random numbers of the host (:func:`~lidargrit.nn.random.of_host`).
    """
    return [phases[int(torch.randint(len(phases), (), generator=rng, device="cpu"))]]


def generated_before(phases: Sequence[Phase]) -> Float[Tensor, "P 1 4 1 1"]:
    """Return 1 for those of the 2x2 pixels, row by row, that are generated before each phase's, and 0 for others."""
    pixels = [(row, column) for row in (0, 1) for column in (0, 1)]
    before = [[float(pixel in phase.lattice.order[: phase.rank]) for pixel in pixels] for phase in phases]
    return torch.tensor(before)[:, None, :, None, None]


def cells_of(maps: Float[Tensor, "B C H W"], lattice: Lattice) -> Float[Tensor, "B C*4 h w"]:
    """Return a lattice of the image with every 2x2 of its pixels as channels of one cell."""
    return F.pixel_unshuffle(maps[(..., *lattice.pixels)], 2)


def pixels_around(
    phase: Phase, values: Float[Tensor, "B H W"], known: Bool[Tensor, "B H W"], offsets: Sequence[tuple[int, int]]
) -> tuple[Float[Tensor, "B N h w"], Bool[Tensor, "B N h w"]]:
    """Return some pixels of earlier phases around each pixel of a phase: their values, and whether they hold one.

    Columns wrap around; rows beyond the image are not known.

    Args:
        phase: phase whose pixels are in the middle; not the first, which has none before it.
        values: values of every pixel.
        known: True where a pixel holds a value.
        offsets: rows and columns of the lattice from the pixel in the middle to others, all of earlier phases.
    """
    # Together they take half as many slices.
    maps = torch.stack([of_image[(..., *phase.lattice.pixels)].to(values.dtype) for of_image in (values, known)], 1)
    (rows, columns), farthest = maps.shape[-2:], max(abs(step) for offset in offsets for step in offset)
    around = torch.arange(-farthest, columns + farthest, device=maps.device) % columns
    maps = F.pad(maps[..., around], (0, 0, farthest, farthest))
    parts = []
    for down, right in offsets:
        top, left = farthest + phase.row + down, farthest + phase.column + right
        parts.append((..., slice(top, top + rows, 2), slice(left, left + columns, 2)))
    values, known = torch.stack([maps[part] for part in parts], 2).unbind(1)
    return values, known > 0


def plane_weights(phase: Phase, elevation_rad: Float[Tensor, "H"]) -> Float[Tensor, "h 1 2"]:
    """Return for each row of a phase the weights of 1 / range in the row above and in the row below, on a plane."""
    height = len(elevation_rad)
    rows = torch.arange(height, device=elevation_rad.device)[phase.pixels[0]]
    above, below = rows - phase.lattice.rows, rows + phase.lattice.rows
    inside = (above >= 0) & (below < height)
    here = elevation_rad[rows]
    up, down = (elevation_rad[row.clamp(0, height - 1)] for row in (above, below))
    between = (up - down).sin()
    weights = torch.stack(((here - down).sin() / between, (up - here).sin() / between), -1)
    return torch.where(inside[:, None], weights, 0.5)[:, None]


def at_phases(values: Shaped[Tensor, "B H W"], phases: list[Phase]) -> Shaped[Tensor, "P B h w"]:
    """Return the pixels of phases of one lattice."""
    return torch.stack([values[(..., *phase.pixels)] for phase in phases])


def join_phases(coarser: Float[Tensor, "B h w"] | None, values: Float[Tensor, "P B k l"]) -> Float[Tensor, "B H W"]:
    """Return a lattice's values, from those of the coarser lattice and those of all phases of its own.

    Args:
        coarser: values of the next coarser lattice; None for the coarsest lattice, which has four phases.
        values: values of two phases where whole columns or rows are known, else of three, or of four, in their order.
    """
    if coarser is not None and coarser.shape[-2] == 2 * values.shape[-2]:  # every second column
        between = torch.stack(tuple(values), 2).flatten(1, 2)
        return torch.stack((coarser, between), -1).flatten(-2)
    if coarser is not None and coarser.shape[-1] == 2 * values.shape[-1]:  # every second row
        between = torch.stack(tuple(values), 3).flatten(2, 3)
        return torch.stack((coarser, between), 2).flatten(1, 2)
    corner = values[0] if coarser is None else coarser
    opposite, right, below = values[-3:]
    return F.pixel_shuffle(torch.stack((corner, right, below, opposite), 1), 2)[:, 0]
