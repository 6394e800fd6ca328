"""KITTI odometry: ROOT/sequences/SS/velodyne/*.bin → scans of 22 drives, 11 of them with a pose."""

from pathlib import Path
from typing import ClassVar

from lidargrit.data.datasets import SplitScheme
from lidargrit.data.datasets.shared.files import FileDataset, unnamed_recording
from lidargrit.data.datasets.shared.labels_beside import label_file, with_labels
from lidargrit.data.formats import BadPoints
from lidargrit.scans.types import Scan

_RAW_DRIVES = {  # which drive of KITTI raw a sequence was cut from; that of 11 to 21 was not published
    "00": "2011_10_03_drive_0027",
    "01": "2011_10_03_drive_0042",
    "02": "2011_10_03_drive_0034",
    "03": "2011_09_26_drive_0067",
    "04": "2011_09_30_drive_0016",
    "05": "2011_09_30_drive_0018",
    "06": "2011_09_30_drive_0020",
    "07": "2011_09_30_drive_0027",
    "08": "2011_09_30_drive_0028",
    "09": "2011_09_30_drive_0033",
    "10": "2011_09_30_drive_0034",
}


class KittiOdometry(FileDataset):
    """The 22 sequences of the KITTI odometry benchmark, motion-corrected; ROOT/dataset/sequences is found too.

    Sequences 00 to 10 are drives of KITTI raw: a scan of each may be in the other, differing by the car's motion.
    A scan has labels where ``labels/NNNNNN.label`` of SemanticKITTI lies beside ``velodyne``. Many programs write this
    layout, ``simulate`` too: a file ``sensor.json`` in the root describes another sensor.

    Source:
        readme.txt of the benchmark's development kit.
    """

    title = "KITTI odometry"
    licence = "CC BY-NC-SA 3.0 (non-commercial)"
    tree = "ROOT/sequences/SS/velodyne/*.bin"
    sensor = "hdl64e_kitti_odometry"
    format = "kitti_bin"
    citation = "Geiger, Lenz, Urtasun: Are we ready for autonomous driving?, CVPR 2012"
    schemes: ClassVar[dict[str, SplitScheme]] = {
        "paper": SplitScheme(
            source="LidarGRIT (Haghighi et al., 2024) and DUSty (Nakashima et al., IROS 2021)",
            leak="val (08) is of the same day, city and car as 04 to 07, 09 and 10 in train.",
            parts={
                "train": ("00", "01", "02", "03", "04", "05", "06", "07", "09", "10"),
                "val": ("08",),
                "test": tuple(f"{sequence:02d}" for sequence in range(11, 22)),
            },
        )
    }
    patterns = ("sequences/*/velodyne/*.bin", "dataset/sequences/*/velodyne/*.bin")

    def __init__(self, root: Path, split: str = "all", bad_points: BadPoints = "refuse") -> None:
        super().__init__(root, split, bad_points)
        self.sensor = self._sensor_beside()

    @classmethod
    def origin_of(cls, root: Path) -> str:
        """Return ``simulated`` for a tree of ``simulate``, "" for one of other verbs, and else see the base."""
        if (root / "simulated.json").is_file():
            return "simulated"
        ours = any((root / name).is_file() for name in ("export.json", "drive.json"))
        return "" if ours else super().origin_of(root)

    def scan(self, index: int) -> Scan:
        """Read one scan, with its labels if there are any."""
        return with_labels(super().scan(index), self.path(index))

    def sidecar_files(self, index: int) -> tuple[Path, ...]:
        """Return the other files that a scan is read from, and its labels."""
        return (*super().sidecar_files(index), label_file(self.path(index)))

    def sequence_of(self, relative: Path) -> str:
        """Name the sequence: "00"."""
        return relative.parts[-3]

    def recording_of(self, path: Path) -> str:
        """Name the drive of KITTI raw that a sequence was cut from, if it is known."""
        if not self._is_its_own:
            return unnamed_recording(path)
        sequence = self.sequence_of(path.relative_to(self.root))
        return f"kitti/{_RAW_DRIVES[sequence]}" if sequence in _RAW_DRIVES else f"kitti_odometry/{sequence}"
