"""An opened source → its scans one after the other, each with the name of the file that is written for it."""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

from lidargrit.core import reporting
from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import ConfigError, OutputError, printable
from lidargrit.core.files import state_of
from lidargrit.data.datasets import ScanDataset, Window
from lidargrit.data.images import RangeImages
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.scan_folder import ScanIdentity
from lidargrit.data.sources import open_source
from lidargrit.data.sources.image_files import ImageFileSource
from lidargrit.data.sources.source import Source
from lidargrit.data.windows import TimedScan
from lidargrit.scans.many_scans import untold, usable_scans
from lidargrit.scans.projection import unproject
from lidargrit.scans.sensors import SensorModel, load_sensor
from lidargrit.scans.types import RangeImage, Scan


class PointScans:
    """Scans of a data set, by their own names.

    Args:
        max_scans: number of scans; 0 for all.
    """

    def __init__(self, dataset: ScanDataset, max_scans: int) -> None:
        self._dataset, self._indices = dataset, evenly_spaced(max_scans or len(dataset), len(dataset))
        self._told = set[str]()

    def __len__(self) -> int:
        return len(self._indices)

    def name(self, index: int) -> str:
        """Return the name of the file that is written for a scan, without the ending: its own in the data set."""
        return self._dataset.name(self._indices[index])

    def identity(self, index: int) -> ScanIdentity:
        """Return its name in the data set, and the state of its file and of those beside it."""
        own = self.path(index)
        files = () if own is None else (own, *self._dataset.sidecar_files(self._indices[index]))
        return ScanIdentity(self.name(index), _state(files))

    def number(self, index: int) -> int:
        """Return its number in the data set, whatever other scans are taken."""
        return self._indices[index]

    def scan(self, index: int) -> Scan:
        """Read its points."""
        return self._dataset.scan(self._indices[index])

    def timed(self, index: int) -> Scan:
        """Read its points, with its time and pose where files beside it tell them."""
        (scan,) = Window(self._dataset, (self._indices[index],)).scans()
        return scan

    def timed_scans(self) -> list[TimedScan]:
        """Return times and poses by files beside the scans."""
        return self._dataset.timed_scans(self._indices)

    def tell_notes(self, scan: Scan) -> None:
        """Report what is noted of the data set and of a scan; notes that differ in numbers alone once."""
        for of, notes in ((str(self._dataset.root), self._dataset.notes), (scan.source, scan.notes)):
            for note in untold(notes, self._told):
                reporting.message(f"{printable(of)}: {note}")

    def sensor(self) -> SensorModel | None:
        """Return the sensor of the data set, unless it may have several or the file that names it is no sensor's."""
        named = self._dataset.named_sensor
        if named and not self._dataset.sensors_differ:
            with suppress(ConfigError):
                return load_sensor(named)
        return None

    def path(self, index: int) -> Path | None:
        """Return the file that holds its points; None where there is none."""
        return self._dataset.path(self._indices[index])

    def check_output(self, out: Path) -> None:
        """Refuse a folder in which the data set would find the written files."""
        if self._dataset.takes_files_in(out):
            got = f"{out}, which lies in {self._dataset.root}: what is written there would be read as further scans"
            raise OutputError(got, "a folder outside the source", "choose another folder")


class ImageScans:
    """Range images as scans.

    Args:
        numbers: numbers of those that are taken.
    """

    def __init__(self, images: RangeImages, names: Sequence[str], numbers: Sequence[int]) -> None:
        self.images, self._names, self._numbers = images, names, numbers

    def __len__(self) -> int:
        return len(self._numbers)

    def name(self, index: int) -> str:
        """Return its name."""
        return self._names[self._numbers[index]]

    def identity(self, index: int) -> ScanIdentity:
        """Return which file it is, which model's seed, or whose scan it was projected from."""
        number = self._numbers[index]
        return ScanIdentity(self.images.provenance.names[number], _state(self.images.files(number)))

    def number(self, index: int) -> int:
        """Return its number in the source."""
        return self._numbers[index]

    def image(self, index: int) -> RangeImage:
        """Return its pixels (H, W)."""
        return self.images.batch([self._numbers[index]])[0]

    def timed_scans(self) -> list[TimedScan]:
        """Return times and poses that were kept with the images."""
        timed = self.images.timed_scans()
        return [timed[number] for number in self._numbers]

    def scan(self, index: int) -> Scan:
        """Return a point for each return."""
        return unproject(self.image(index))

    def timed(self, index: int) -> Scan:
        """Return a point for each return; an image tells no time of its own."""
        return self.scan(index)

    def path(self, index: int) -> None:
        """Return nothing: its points are in no file."""

    def sensor(self) -> SensorModel:
        """Return the sensor of the images."""
        return self.images.sensor

    def tell_notes(self, scan: Scan) -> None:
        """Report nothing: pixels have no notes."""

    def check_output(self, out: Path) -> None:
        """Accept every folder: images are looked for in one folder alone, by names that are not written there."""


NamedScans: TypeAlias = PointScans | ImageScans
"""Scans of any source by their numbers from 0 on, with the name of the file that is written for each."""


def _state(files: Iterable[Path]) -> str:
    return ", ".join("{} bytes of {} ns".format(*state) for state in map(state_of, files) if state)


def named_scans(source: Source, config: DataConfig, sensor: SensorModel | None = None) -> NamedScans:
    """Return the scans of a source: named as in their data set or as their image's file, else by their index.

    Args:
        sensor: sensor of range images that do not name theirs; see :meth:`Source.images`.
    """
    if source.has_points:
        return PointScans(source.scans(), config.max_scans)
    images = source.images(sensor, source.as_projected(replace(config, max_scans=0)))
    names = [f"{number:06d}" for number in range(len(images))]
    if isinstance(source, ImageFileSource):
        names = [_name_of(Path(name)) for name in images.provenance.names]
    return ImageScans(images, names, evenly_spaced(config.max_scans or len(images), len(images)))


def _name_of(image: Path) -> str:
    return image.stem if image.suffix == ".npy" else image.name  # beside scan.npy there may lie scan.NPY


def first_scan(text: str, config: DataConfig) -> tuple[Scan, str]:
    """Read the first scan of a source, or the first that can be used if the others may be skipped.

    Args:
        text: file of a scan, or source of scans.
        config: treatment of bad points and bad scans.

    Returns:
        the scan, whose notes name those that were skipped; and the sensor of the data set, "" where none is known.
    """
    dataset = open_source(text, config.bad_points).scans()
    if config.bad_scans == "refuse":
        scan, skipped = dataset.scan(0), ()
    else:
        (scan,), skipped = usable_scans(dataset, range(len(dataset)), at_most=1)
    return replace(scan, notes=(*dataset.notes, *skipped, *scan.notes)), dataset.named_sensor
