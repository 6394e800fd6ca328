"""KITTI object: ROOT/{training,testing}/velodyne/*.bin → single scans out of many drives."""

from pathlib import Path
from typing import ClassVar

from lidargrit.data.datasets import SplitScheme
from lidargrit.data.datasets.shared.files import FileDataset


class KittiObject(FileDataset):
    """The scans of the KITTI object benchmark; ``training`` and ``testing`` are its two sequences.

    Neighbouring numbers are not neighbours in time: a share such as ``training[90%:]`` has frames of the same drives as
    the rest, and many of KITTI raw's drives are in here. Which scan is of which drive is in the benchmark's own mapping
    file, which is not read: overlaps with other data sets of KITTI go unseen.
    """

    title = "KITTI object"
    licence = "CC BY-NC-SA 3.0 (non-commercial)"
    tree = "ROOT/{training,testing}/velodyne/*.bin"
    sensor = "hdl64e_kitti_odometry"
    format = "kitti_bin"
    citation = "Geiger, Lenz, Urtasun: Are we ready for autonomous driving?, CVPR 2012"
    schemes: ClassVar[dict[str, SplitScheme]] = {
        "official": SplitScheme(
            source="the folders of the benchmark",
            leak="All are cut from drives of KITTI raw, by one car in one city; which ones the names do not tell.",
            parts={"train": ("training",), "test": ("testing",)},
        )
    }
    patterns = ("t*ing/velodyne/*.bin",)

    def sequence_of(self, relative: Path) -> str:
        """Name the half of the benchmark: "training"."""
        return relative.parts[-3]
