"""What a generator is told of training scans: the name of a kind, as in ``data.condition=NAME`` → how scans tell it."""

from abc import ABC, abstractmethod
from typing import ClassVar

from lidargrit.core import discovery
from lidargrit.scans.condition import Condition
from lidargrit.scans.past import Past
from lidargrit.scans.types import RangeImage


class ToldOfScans(ABC):
    """How scans tell a generator what it is to know of them; one kind a file."""

    kind: ClassVar[type[Condition]]
    """Conditions that it returns; a generator that learns by them has them in ``takes``."""

    def __init__(self, past_scans: int = 0) -> None:
        self.past_scans = past_scans if self.kind is Past else 0
        """Number of scans before each in its drive that the generator is told, where a drive has them; 0 for none."""

    @abstractmethod
    def of(self, images: RangeImage) -> Condition:
        """Return what a generator is told of each image."""


def load(name: str, past_scans: int = 0) -> ToldOfScans:
    """Return the kind of condition of a name, or raise UnknownNameError.

    Args:
        past_scans: number of past scans that the generator takes.
    """
    kind: type[ToldOfScans] = discovery.load_class("conditions", name, ToldOfScans)
    return kind(past_scans)
