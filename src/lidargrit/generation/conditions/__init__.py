"""What a generator is told of training scans: the name of a kind, as in ``data.condition=NAME`` → how scans tell it."""

from abc import ABC, abstractmethod
from typing import ClassVar

from lidargrit.core import discovery
from lidargrit.scans.condition import Condition
from lidargrit.scans.types import RangeImage


class ToldOfScans(ABC):
    """How scans tell a generator what it is to know of them; one kind a file."""

    kind: ClassVar[type[Condition]]
    """Conditions that it returns; a generator that learns by them has them in ``takes``."""

    @abstractmethod
    def of(self, images: RangeImage) -> Condition:
        """Return what a generator is told of each image."""


def load(name: str) -> ToldOfScans:
    """Return the kind of condition of a name, or raise UnknownNameError."""
    kind: type[ToldOfScans] = discovery.load_class("conditions", name, ToldOfScans)
    return kind()
