"""KITTI object: ROOT/{training,testing}/velodyne/*.bin → single scans out of many drives."""

from __future__ import annotations

from pathlib import Path

from lidargrit.datasets._files import BinDataset


class KittiObject(BinDataset):
    """The scans of the KITTI object benchmark; ``training`` and ``testing`` are its two sequences.

    Neighbouring numbers are not neighbours in time: a share such as ``training[90%:]`` has frames of the same drives as
    the rest, and many of KITTI raw's drives are in here.

    Source:
        Geiger et al., CVPR 2012.
    """

    title = "KITTI object"
    licence = "CC BY-NC-SA 3.0 (non-commercial)"
    tree = "ROOT/{training,testing}/velodyne/*.bin"
    sensor = "hdl64e_kitti_odometry"
    patterns = ("t*ing/velodyne/*.bin",)
    examples = ("training/velodyne/{index:06d}.bin", "testing/velodyne/{index:06d}.bin")

    @staticmethod
    def sequence_of(relative: Path) -> str:
        """Name the half of the benchmark: "training"."""
        return relative.parts[-3]
