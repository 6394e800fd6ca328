"""Any folder with Velodyne files in it, however deep: ROOT/**/*.bin → scans."""

from __future__ import annotations

from pathlib import Path

from lidargrit.datasets._files import BinDataset


class Folder(BinDataset):
    """Your own scans as KITTI-style .bin files; a sequence is the folder that holds them, "." for the root itself."""

    title = "a folder of .bin files"
    licence = "that of your files"
    tree = "ROOT/**/*.bin"
    sensor = "hdl64e_kitti_odometry"
    patterns = ("**/*.bin",)
    examples = ("{index:06d}.bin", "more/{index:06d}.bin")

    @staticmethod
    def sequence_of(relative: Path) -> str:
        """Name the folder of a file."""
        return relative.parent.as_posix()
