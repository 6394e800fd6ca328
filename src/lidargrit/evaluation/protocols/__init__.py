"""The name of a protocol → the metrics that it asks for, and the images on which it computes them."""

from dataclasses import asdict, dataclass, replace

from lidargrit.core import discovery
from lidargrit.core.files import sha256_of_json
from lidargrit.scans.projection import ProjectionVariant
from lidargrit.scans.sensors import SensorModel, load_sensor

DEFAULT = "exact"


@dataclass(frozen=True)
class MetricChoice:
    """One number that a protocol asks for.

    Args:
        variant: published definition of the metric; its first one if empty.
    """

    metric: str
    variant: str = ""


@dataclass(frozen=True)
class Protocol:
    """Everything that must be equal before two scores of one name may be compared.

    Args:
        source: paper or program (with its commit) that the protocol follows.
        sensor: name of the sensor whose rays the images have; that of the samples or of the scans if empty.
        columns: number of columns of the full circle; the sensor's own if 0.
        range_m: open interval of range in metres, outside which a return of either set counts as no return; the
            sensor's own limits if None.
        num_scans: number of scans of each set; as many as there are if 0.
        data_set: name of the data set of the reference; any if empty.
        splits: names that the split of the reference may have; any if empty.
        first_points: number of points of each cloud of the samples that are scored, the first of its file; 0 for all.
        departures: differences from the source, each with what it changes.
    """

    title: str
    source: str
    metrics: tuple[MetricChoice, ...]
    sensor: str = ""
    columns: int = 0
    column_stride: int = 1
    variant: ProjectionVariant = "exact"
    range_m: tuple[float, float] | None = None
    num_scans: int = 0
    data_set: str = ""
    splits: tuple[str, ...] = ()
    first_points: int = 0
    departures: tuple[str, ...] = ()

    def load_sensor(self) -> SensorModel | None:
        """Return the sensor whose rays the images should have; None if any will do."""
        if not self.sensor:
            return None
        sensor = load_sensor(self.sensor)
        return sensor.with_columns(self.columns, self.column_stride) if self.columns else sensor

    @property
    def sha256(self) -> str:
        """Hash of all that a protocol fixes, without what it says of itself."""
        told = {"title": "", "source": "", "departures": ()}
        return sha256_of_json(asdict(replace(self, **told)))

    def scans_at_most(self, wanted: int = 0) -> int:
        """Return the largest number of scans of each set; 0 for as many as there are.

        Args:
            wanted: largest number that the user wants; 0 for the protocol's.
        """
        return min((count for count in (wanted, self.num_scans) if count), default=0)


def load_protocol(name: str) -> Protocol:
    """Return a protocol by its name, with "-" or "_".

    Example:
        >>> load_protocol("lidargrit-kitti-360").num_scans
        5000
    """
    return discovery.load_instance("protocols", public_name(name), Protocol)


def public_name(name: str) -> str:
    """Return the file name of what a user types, such as lidargrit_kitti_360 of "LidarGRIT-KITTI-360"."""
    return name.strip().lower().replace("-", "_")
