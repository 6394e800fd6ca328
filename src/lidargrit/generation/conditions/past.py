"""Past: a generator is told the scans of the drive before each, with their poses."""

from lidargrit.generation.conditions import ToldOfScans
from lidargrit.scans.past import Past
from lidargrit.scans.types import RangeImage


class PastTold(ToldOfScans):
    """The scans before each in its drive, as many as the generator's ``past_scans``; images alone have no past."""

    kind = Past

    def of(self, images: RangeImage) -> Past:
        """Return that there was nothing before."""
        return Past.nothing(images.sensor, len(images), self.past_scans).to(images.range_m.device)
