"""Argoverse 2: ROOT/{train,val,test}/LOG/sensors/lidar/*.feather → scans of the upright one of two VLP-32C."""

from pathlib import Path
from typing import ClassVar

import torch

from lidargrit.data.datasets import SplitScheme
from lidargrit.data.datasets.shared.files import FileDataset, unnamed_recording
from lidargrit.data.formats.argoverse_feather import sensor_poses
from lidargrit.scans.motion import Motion


class Argoverse2(FileDataset):
    """The sensor and the lidar data set of Argoverse 2; a sequence is ``train/LOG``.

    A file holds the points of two sensors. A scan is those of the upright one, so that all scans have one sensor's
    rays; for the one below it, upside down, use ``lidargrit.load_scan(FILE, 1)``. The folder of a split, of a log, or
    of .feather files alone is read, too; then there are no named splits.
    """

    title = "Argoverse 2"
    licence = "CC BY-NC-SA 4.0 (non-commercial)"
    tree = "ROOT/{train,val,test}/LOG/sensors/lidar/*.feather"
    sensor = "vlp32c"
    format = "argoverse_feather"
    citation = "Wilson et al.: Argoverse 2, NeurIPS Datasets and Benchmarks 2021"
    schemes: ClassVar[dict[str, SplitScheme]] = {
        "official": SplitScheme(
            source="the folders of the data set",
            leak="Over 40 % of val and test lie within 5 m of a place in train (Lilja et al., CVPR 2024).",
            parts={"train": ("train/*",), "val": ("val/*",), "test": ("test/*",)},
        )
    }
    patterns = (
        "*/*/sensors/lidar/*.feather",
        "*/sensors/lidar/*.feather",
        "sensors/lidar/*.feather",
        "*.feather",
    )

    def motion(self, index: int) -> Motion:
        """Return time and pose of a scan, by its file's name and ``city_SE3_egovehicle.feather`` of its log."""
        path = self.path(index)
        if not path.stem.isdecimal():
            return Motion()
        pose = sensor_poses(path).get(int(path.stem))
        return Motion(int(path.stem) / 1e9, None if pose is None else torch.from_numpy(pose))

    def sequence_of(self, relative: Path) -> str:
        """Name the split and the log of a file."""
        return "/".join(relative.parts[:-3]) or "."

    def recording_of(self, path: Path) -> str:
        """Name the log of a file, also where the root is the log itself."""
        folder = path.resolve().parent
        in_a_log = folder.parts[-2:] == ("sensors", "lidar")
        return f"argoverse2/{folder.parts[-3]}" if in_a_log else unnamed_recording(path)
