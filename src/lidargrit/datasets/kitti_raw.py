"""KITTI raw: ROOT/YYYY_MM_DD/DRIVE_sync/velodyne_points/data/*.bin → scans of drives, chosen by name."""

from __future__ import annotations

from pathlib import Path

from lidargrit.datasets._files import BinDataset


class KittiRaw(BinDataset):
    """The synchronised drives of KITTI raw; there is no official split, so drives are chosen by their folder's name.

    Source:
        Geiger et al., IJRR 2013.
    """

    title = "KITTI raw"
    licence = "CC BY-NC-SA 3.0 (non-commercial)"
    tree = "ROOT/YYYY_MM_DD/YYYY_MM_DD_drive_DDDD_sync/velodyne_points/data/*.bin"
    sensor = "hdl64e_kitti_odometry"
    patterns = ("????_??_??/*_sync/velodyne_points/data/*.bin",)
    examples = (
        "2011_09_26/2011_09_26_drive_0001_sync/velodyne_points/data/{index:010d}.bin",
        "2011_09_28/2011_09_28_drive_0002_sync/velodyne_points/data/{index:010d}.bin",
    )

    @staticmethod
    def sequence_of(relative: Path) -> str:
        """Name the drive: "2011_09_26_drive_0001_sync"."""
        return relative.parts[-4]
