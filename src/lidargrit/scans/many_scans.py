"""Many scans that are read when asked for → those of them that can be used, and what is told of them."""

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Protocol, runtime_checkable

from lidargrit.core import reporting
from lidargrit.core.errors import ScanError
from lidargrit.scans.types import Scan

_TOLD_AT_MOST = 5  # scans that are left out
_NUMBER = re.compile(r"-?\d[\d.,]*")


@runtime_checkable
class ManyScans(Protocol):
    """Scans that are read when asked for, such as a data set."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences that a reader of the scans should know."""
        ...

    def __len__(self) -> int:
        """Return the number of scans."""
        ...

    def scan(self, index: int) -> Scan:
        """Read one scan."""
        ...


def untold(notes: Iterable[str], told: set[str]) -> list[str]:
    """Return the notes that differ from one another, and from those that were told, in more than numbers.

    Args:
        told: notes that were told so far, without their numbers; the new ones are added.
    """
    new = list[str]()
    for note in notes:
        if (kind := _NUMBER.sub("", note)) not in told:
            told.add(kind)
            new.append(note)
    return new


@contextmanager
def leaving_out(skips: bool) -> Iterator[None]:
    """Report why a scan cannot be used that is refused within the block; let the refusal through if none is skipped."""
    try:
        yield
    except ScanError as error:
        if not skips:
            raise
        reporting.message(f"left out: {error.as_left_out()}")


def usable_scans(dataset: ManyScans, indices: Iterable[int], at_most: int = 0) -> tuple[list[Scan], tuple[str, ...]]:
    """Read some scans without those that cannot be used, and say which these are.

    Args:
        dataset: scans to choose from.
        indices: numbers of the wanted scans, in order.
        at_most: number of usable scans after which no further one is read; 0 for all.
    """
    scans, skipped = list[Scan](), list[str]()
    error = None
    for index in indices:
        if at_most and len(scans) == at_most:
            break
        try:
            scans.append(dataset.scan(index))
        except ScanError as wrong:
            error = wrong.as_left_out()
            skipped.append(f"left out: {error}")
    if error and not scans:
        raise error
    if len(skipped) > _TOLD_AT_MOST:
        skipped[_TOLD_AT_MOST:] = [f"and {len(skipped) - _TOLD_AT_MOST} more left out"]
    return scans, tuple(skipped)
