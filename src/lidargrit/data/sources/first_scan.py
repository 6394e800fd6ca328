"""A source of scans → its first scan, and the sensor that its data set names."""

from dataclasses import replace
from pathlib import Path

from lidargrit.data.formats import read_scan
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import open_source
from lidargrit.scans.many_scans import usable_scans
from lidargrit.scans.types import Scan


def first_scan(text: str, config: DataConfig) -> tuple[Scan, str]:
    """Read the first scan of a source, or the first that can be used if the others may be skipped.

    Args:
        text: file of a scan, or source of scans.
        config: treatment of bad points and bad scans.

    Returns:
        the scan, whose notes name those that were skipped; and the sensor of the data set, "" where none is known.
    """
    skips = config.bad_scans == "skip"
    if Path(text).is_file() and not skips:
        return read_scan(text, bad_points=config.bad_points), ""
    source = open_source(text, config.bad_points)
    dataset = source.scans()
    # The files of a folder that is no known data set tell no sensor, as a file alone tells none.
    sensor = "" if source.data_set == "folder" else dataset.sensor
    if not skips:
        scan, skipped = dataset.scan(0), ()
    else:
        (scan,), skipped = usable_scans(dataset, range(len(dataset)), at_most=1)
    return replace(scan, notes=(*dataset.notes, *skipped, *scan.notes)), sensor
