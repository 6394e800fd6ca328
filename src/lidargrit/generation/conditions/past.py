"""Past: a generator is told the scans of the drive before each, with their poses."""

from typing import ClassVar

from lidargrit.generation.conditions import ToldOfScans
from lidargrit.scans.past import Past
from lidargrit.scans.types import RangeImage


class PastTold(ToldOfScans):
    """The five scans before each in its drive are told; images alone have no past."""

    kind = Past
    past_scans: ClassVar[int] = 5

    def of(self, images: RangeImage) -> Past:
        """Return that there was nothing before."""
        return Past.nothing(images.sensor, len(images), self.past_scans).to(images.range_m.device)
