"""Procedural streets, simulated when asked for: COUNT → scans, one seed each."""

from lidargrit.data.datasets.shared.streets import Streets
from lidargrit.scans.types import Scan


class Simulated(Streets):
    """Scans of simulated streets.

    Args:
        root: number of scans, where other data sets have a folder, or ``COUNT@SENSOR``.
        split: ``train``, ``val`` or ``test``.
        bad_points: without effect; the simulator makes none.
    """

    title = "simulated streets"

    def scan(self, index: int) -> Scan:
        """Simulate one scan."""
        # Only here: naming and counting need no simulator.
        from lidargrit.simulator import simulate  # noqa: PLC0415

        return simulate(seed=self.seeds[index], sensor=self.made_by)
