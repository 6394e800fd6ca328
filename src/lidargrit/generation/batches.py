"""Seeds → scans that are computed in batches of one size, so that a scan depends on its seed alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import overload

from lidargrit.scans.types import RangeImage


class BatchSeeds(Sequence[int]):
    """Seeds of one batch: those asked for, then copies of the last one that fill the batch up.

    Args:
        asked_for: seeds whose scans are wanted.
        size: number of scans of a batch.
    """

    def __init__(self, asked_for: Sequence[int], size: int) -> None:
        self._seeds = (*asked_for, *[asked_for[-1]] * (size - len(asked_for)))
        self.num_asked_for = len(asked_for)

    def __len__(self) -> int:
        return len(self._seeds)

    @overload
    def __getitem__(self, index: int) -> int: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[int, ...]: ...
    def __getitem__(self, index: int | slice) -> int | tuple[int, ...]:
        return self._seeds[index]


def in_batches(seeds: Sequence[int], size: int, compute: Callable[[list[int], BatchSeeds], RangeImage]) -> RangeImage:
    """Compute one scan for each seed in batches of one size.

    Args:
        seeds: seeds, one for each scan.
        size: number of scans of a batch.
        compute: function from the indices and the seeds of a batch to its scans; those of the copies are dropped, and
            may be left out.
    """
    parts = []
    for first in range(0, len(seeds), size):
        wanted = range(first, min(first + size, len(seeds)))
        indices = [*wanted, *[wanted[-1]] * (size - len(wanted))]
        parts.append(compute(indices, BatchSeeds([int(seeds[index]) for index in wanted], size))[: len(wanted)])
    return RangeImage.cat(parts)


def one_by_one(images: RangeImage) -> Iterator[RangeImage]:
    """Yield batches of one image each, for work without seeds: what it gives for a scan depends on that scan alone.

    A network takes as long for each scan of a batch, and the memory of one is enough for any number of them.
    """
    for index in range(len(images)):
        yield images[index : index + 1]
