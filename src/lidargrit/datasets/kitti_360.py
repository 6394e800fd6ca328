"""KITTI-360: ROOT/data_3d_raw/2013_05_28_drive_SSSS_sync/velodyne_points/data/*.bin → scans of 9 long drives."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from lidargrit.datasets._files import BinDataset


class Kitti360(BinDataset):
    """The raw Velodyne scans of KITTI-360, with the training and test drives of LiDARGen and LidarGRIT.

    There is no official validation split. LidarGRIT's program validates its first stage on drive 0005, which it also
    trains on, and its second stage on drive 0000, which it also tests on. To choose a checkpoint without either leak,
    train on ``train_without_val`` and validate on ``val``; ``train`` is for numbers to set beside published ones. All
    drives, the test drives too, are of one city, one day and one car.

    Source:
        Liao et al., PAMI 2022; splits: Zyrianov et al., LiDARGen, ECCV 2022, and hamedhaghighi/LidarGRIT@a3f86e7.
    """

    title = "KITTI-360"
    licence = "CC BY-NC-SA 3.0 (non-commercial)"
    tree = "ROOT/data_3d_raw/2013_05_28_drive_SSSS_sync/velodyne_points/data/*.bin"
    sensor = "hdl64e_kitti_360"
    splits: ClassVar[dict[str, tuple[str, ...]]] = {
        "train": ("0003", "0004", "0005", "0006", "0007", "0009", "0010"),
        "train_without_val": ("0003", "0004", "0006", "0007", "0009", "0010"),
        "val": ("0005",),
        "test": ("0000", "0002"),
    }
    patterns = ("data_3d_raw/2013_05_28_drive_????_sync/velodyne_points/data/*.bin",)
    examples = (
        "data_3d_raw/2013_05_28_drive_0000_sync/velodyne_points/data/{index:010d}.bin",
        "data_3d_raw/2013_05_28_drive_0003_sync/velodyne_points/data/{index:010d}.bin",
    )

    @staticmethod
    def sequence_of(relative: Path) -> str:
        """Name the drive by its number: "0003"."""
        return relative.parts[-4].removeprefix("2013_05_28_drive_").removesuffix("_sync")
