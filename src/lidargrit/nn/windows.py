"""Windows of columns of a token grid: what a transformer reads at once, where whole scans are too long for it."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Int, Shaped
from torch import Tensor

from lidargrit.core.errors import ConfigError

_LEAST = 8  # columns of a window, of which one column in so many is one of the grid's first
_FIRST_SHARE = 0.2  # of the windows that are drawn, those that are the first: there alone nothing stands yet
_LAST_SHARE = 0.1  # and those that are the last: there alone the last column meets the first


class Window(NamedTuple):
    """One window.

    Args:
        columns: numbers of its columns in the grid.
        known: number of its first columns that earlier windows have.
    """

    columns: Int[Tensor, "W"]
    known: int


@dataclass(frozen=True)
class Windows:
    """How windows go over a grid of tokens, column by column, as the sensor turns.

    The first window is the grid's first columns. Every other begins with a few of these again, so that the scan's end
    can meet its beginning, and goes on with columns of which earlier windows have the first half.

    Args:
        grid_size: rows and columns of the grid.
        columns: number of columns of a window.
    """

    grid_size: tuple[int, int]
    columns: int

    def __post_init__(self) -> None:
        if not _LEAST <= self.columns < self.grid_size[1]:
            raise ConfigError(
                f"model.transformer.window_columns={self.columns} for tokens in {self.grid_size[1]} columns",
                f"from {_LEAST} to {self.grid_size[1] - 1}",
                "change it, or leave it out: 0 reads whole scans",
            )

    @property
    def length(self) -> int:
        """Number of tokens in a window."""
        return self.columns * self.grid_size[0]

    @property
    def first(self) -> int:
        """Number of the grid's first columns with which each later window begins."""
        return self.columns // _LEAST

    def in_turn(self) -> list[Window]:
        """Return the windows that together have every column, in the order in which they are sampled."""
        found, done, own = [Window(self._columns(self.first), 0)], self.columns, self.columns - self.first
        while done < self.grid_size[1]:
            start = min(done - own // 2, self.grid_size[1] - own)
            found.append(Window(self._columns(start), self.first + done - start))
            done = start + own
        return found

    def draw(self, count: int, rng: torch.Generator) -> tuple[Int[Tensor, "B W"], Bool[Tensor, "B W"]]:
        """Return the columns of random windows, and which of these a training is to learn.

        Args:
            count: number of windows.
            rng: random numbers on the CPU.
        """
        last = self.grid_size[1] - (self.columns - self.first)
        starts = torch.randint(self.first + 1, last + 1, (count, 1), generator=rng)
        kind = torch.rand((count, 1), generator=rng)
        is_first = kind < _FIRST_SHARE
        starts = torch.where(kind < 1 - _LAST_SHARE, starts, last)
        columns = self._columns(torch.where(is_first, self.first, starts))
        return columns, is_first | (torch.arange(self.columns) >= self.first)

    def take(self, grid: Shaped[Tensor, "B h w"], columns: Int[Tensor, "*C W"]) -> Shaped[Tensor, "B T"]:
        """Return what a grid has in windows, column by column."""
        columns = columns.to(grid.device).expand(len(grid), -1)
        return grid.gather(2, columns[:, None].expand(-1, grid.shape[1], -1)).transpose(1, 2).flatten(1)

    def _columns(self, start: int | Int[Tensor, "B 1"]) -> Int[Tensor, "*B W"]:
        """Return the first columns, and those that begin at ``start``; at ``first`` it is the first window."""
        number = torch.arange(self.columns)
        return torch.where(number < self.first, number, number - self.first + start)
