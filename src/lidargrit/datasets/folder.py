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

    @classmethod
    def matches(cls, root: Path) -> bool:
        """Tell whether this is a folder with such a file in it, or the file itself."""
        return cls._is_scan(root) or super().matches(root)

    @classmethod
    def _find(cls, root: Path) -> list[Path]:
        return [root] if cls._is_scan(root) else super()._find(root)

    @staticmethod
    def _is_scan(root: Path) -> bool:
        return root.suffix == ".bin" and root.is_file()

    @staticmethod
    def sequence_of(relative: Path) -> str:
        """Name the folder of a file."""
        return relative.parent.as_posix()
