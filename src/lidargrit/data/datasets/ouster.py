"""Ouster recordings: ROOT/*.pcap with a .json of the same name → one scan for each revolution."""

from contextlib import suppress
from pathlib import Path

from lidargrit.core.errors import ScanError
from lidargrit.data.datasets.shared.files import FileDataset, hashed_name
from lidargrit.data.formats import BadPoints, stem
from lidargrit.data.formats.ouster_pcap import sensor_of


class Ouster(FileDataset):
    """Recordings of any Ouster sensor; a sequence is a recording. There are no named splits.

    The sensor is the OS1 with as many beams as the first recording's, if there is one of ours. Its angles are those of
    one unit; yours are in your metadata, and ``lidargrit.data.formats.ouster_pcap.sensor_of(FILE).to_json()`` gives a
    sensor file for ``data.sensor``.
    """

    title = "Ouster recordings"
    licence = "that of your files"
    tree = "ROOT/NAME.pcap with ROOT/NAME.json, or both one folder deeper"
    sensor = "os1_128"
    sensors_differ = True
    format = "ouster_pcap"
    citation = "none: your recordings"
    patterns = ("*.pcap", "*/*.pcap")

    def __init__(self, root: Path, split: str = "all", bad_points: BadPoints = "refuse") -> None:
        super().__init__(root, split, bad_points)
        with suppress(ScanError):  # which reading the scan will tell
            if sensor_of(self.path(0)).height == 64:
                self.sensor = "os1_64"

    def name(self, index: int) -> str:
        """Name one scan by its recording and its index in it."""
        path, index_in_file = self._scans[index]
        return f"{self.sequence_of(path.relative_to(self.root))}#{index_in_file}"

    def sequence_of(self, relative: Path) -> str:
        """Name the recording."""
        return (relative.parent / stem(relative)).as_posix()

    def recording_of(self, path: Path) -> str:
        """Name a recording by its file."""
        return hashed_name(path.resolve())
