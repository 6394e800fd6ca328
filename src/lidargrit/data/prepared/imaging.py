"""A few scans of a set → the projection for all of them, and signs of a wrong sensor."""

from dataclasses import dataclass, replace

from lidargrit.core import reporting
from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import ScanError
from lidargrit.data.datasets import ScanDataset
from lidargrit.data.prepared.config import DataConfig
from lidargrit.scans.many_scans import untold
from lidargrit.scans.projection import projection_that_fits
from lidargrit.scans.projection.sensor_check import told_doubts
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import Scan

_PROBES = 3  # scans that are looked at: the first would do, were a folder not sometimes a mixture


@dataclass(frozen=True, eq=False)
class ProjectionChoice:
    """Settings by which the scans of one set become images.

    Args:
        config: settings of the projection, with the variant that fits the scans.
        notes: sentences on what was chosen in place of what the sensor and the settings say, and on what was
            left out of the files.
        doubts: sentences that tell why another sensor than this one may have made the scans, or more than one
            revolution lies in each.
    """

    sensor: SensorModel
    config: DataConfig
    notes: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()

    def report(self) -> None:
        """Report what was chosen, and warn of what is in doubt."""
        for line in (*self.notes, *(f"WARNING: {doubt}" for doubt in self.doubts)):
            reporting.message(line)


def choose_projection(source: str, dataset: ScanDataset, sensor: SensorModel, config: DataConfig) -> ProjectionChoice:
    """Look at a few scans of a set, and choose the projection for all of them.

    Points that are not in firing order get their rows by elevation, in the exact variant, since their order does not
    show their rows. ``projection=unfolding`` keeps the order nevertheless, and such scans are then refused one by one.

    Args:
        source: name of the set, for notes and doubts.
        dataset: scans of the set. Simulated ones are looked at only if they are of another sensor.
        config: settings of the projection; one that is named there comes before the sensor's own.
    """
    if config.projection != "sensor":
        sensor = replace(sensor, projection=config.projection)
    probes = _probes(dataset, sensor)
    told = untold((*dataset.notes, *(note for scan in probes for note in scan.notes)), set())
    notes = [f"{source}: {note}" for note in told]
    fitting = {projection_that_fits(scan, sensor) for scan in probes} if config.projection == "sensor" else set()
    if fitting - {sensor.projection}:
        sensor, config = replace(sensor, projection="spherical"), replace(config, projection_variant="exact")
        notes.append(f"{source}: points that are not in firing order, so rows go by elevation (projection=spherical)")
    told_of_scans = (told_doubts(scan, sensor, sensor.projection, source) for scan in probes)
    first_of_each = (next(filter(None, told), "") for told in zip(*told_of_scans, strict=True))
    return ProjectionChoice(sensor, config, tuple(notes), tuple(filter(None, first_of_each)))


def _probes(dataset: ScanDataset, sensor: SensorModel) -> list[Scan]:
    """Read a few scans, without those that cannot be used, which are refused or left out later."""
    files = {dataset.path(index): index for index in reversed(evenly_spaced(_PROBES, len(dataset)))}
    if None in files and dataset.sensor == sensor.name:
        return []
    found = []
    for index in files.values():
        try:
            found.append(dataset.scan(index))
        except ScanError:
            continue
    return found
