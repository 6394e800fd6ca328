"""Nothing: a generator learns all scans alike and samples new ones by their seeds alone."""

from lidargrit.generation.conditions import ToldOfScans
from lidargrit.scans.condition import NOTHING, Nothing
from lidargrit.scans.types import RangeImage


class NothingTold(ToldOfScans):
    """No image tells anything."""

    kind = Nothing

    def of(self, images: RangeImage) -> Nothing:
        """Return nothing."""
        return NOTHING
