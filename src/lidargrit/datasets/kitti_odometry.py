"""KITTI odometry: ROOT/sequences/SS/velodyne/*.bin → scans of 22 drives, 11 of them with a pose."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from lidargrit.datasets._files import BinDataset


class KittiOdometry(BinDataset):
    """The 22 sequences of the KITTI odometry benchmark, motion-corrected; ROOT/dataset/sequences is found too.

    The splits are those of the LidarGRIT paper. Their leak: the validation sequence 08 was recorded on the same day, in
    the same city and with the same sensor as the training sequences 04 to 07, 09 and 10.

    Source:
        Geiger et al., CVPR 2012; splits: Haghighi et al., LidarGRIT, 2024.
    """

    title = "KITTI odometry"
    licence = "CC BY-NC-SA 3.0 (non-commercial)"
    tree = "ROOT/sequences/SS/velodyne/*.bin"
    sensor = "hdl64e_kitti_odometry"
    splits: ClassVar[dict[str, tuple[str, ...]]] = {
        "train": ("00", "01", "02", "03", "04", "05", "06", "07", "09", "10"),
        "val": ("08",),
        "test": tuple(f"{sequence:02d}" for sequence in range(11, 22)),
    }
    patterns = ("sequences/*/velodyne/*.bin", "dataset/sequences/*/velodyne/*.bin")
    examples = ("sequences/00/velodyne/{index:06d}.bin", "sequences/08/velodyne/{index:06d}.bin")

    @staticmethod
    def sequence_of(relative: Path) -> str:
        """Name the sequence: "00"."""
        return relative.parts[-3]
