"""Simulated streets with a point on every surface, marked by which beams came back and how bright: to learn raydrop."""

from lidargrit.data.datasets.shared.streets import Streets
from lidargrit.scans.types import Scan


class SimulatedSurfaces(Streets):
    """The streets of ``simulated``, seed by seed, as they would be measured if every surface returned.

    The reflectance is 0.5 + half of what ``simulated`` reads where it has a return, and 0 where that beam was lost.

    Args:
        root: number of scans, where other data sets have a folder, or ``COUNT@SENSOR``.
        split: ``train``, ``val`` or ``test``.
        bad_points: without effect; the simulator makes none.
    """

    title = "simulated streets: every surface, and which of them return"

    def name(self, index: int) -> str:
        """Name one scan by its seed, and not as that of the street which is measured: "surfaces_0000012"."""
        return f"surfaces_{self.seeds[index]:07d}"

    def scan(self, index: int) -> Scan:
        """Simulate one scan."""
        # Only here: naming and counting need no simulator.
        from lidargrit.simulator import observe  # noqa: PLC0415

        sensor, source = self.made_by, f"surfaces of seed {self.seeds[index]}"
        return observe(self.seeds[index], sensor).surfaces(source, (sensor.range_min_m, sensor.range_max_m))
