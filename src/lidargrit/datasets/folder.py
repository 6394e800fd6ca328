"""Your own scans, in any format that is known and several at once: ROOT/** → scans."""

from __future__ import annotations

import re
from pathlib import Path

from lidargrit import formats
from lidargrit.datasets._files import FileDataset, scans_below, unnamed_recording
from lidargrit.determinism import natural_order
from lidargrit.formats import BadPoints

_TOPIC = re.compile(r"(/[^\[\]]+)(\[[^\]]*\])?")


class Folder(FileDataset):
    """A folder of scans, or one file; a sequence is the folder that holds them, "." for the root itself.

    Every file whose ending belongs to a format is a scan, hidden ones left out. The sensor is that of the first file's
    format, if such files always have the same, and the HDL-64E of KITTI otherwise; choose yours with ``data.sensor``.
    """

    title = "a folder of scan files"
    licence = "that of your files"
    tree = "ROOT/**/FILE of any known format (lidargrit list formats)"
    sensor = "hdl64e_kitti_odometry"
    format = ""
    citation = "that of your files"
    patterns = ("**/*",)
    examples = ("{index:06d}.bin", "more/{index:06d}.bin")

    def __init__(self, root: Path, split: str = "all", bad_points: BadPoints = "refuse") -> None:
        found = _TOPIC.fullmatch(split)
        if found:
            self.topic, split = found[1], f"all{found[2] or ''}"
        super().__init__(root, split, bad_points)
        sensors = [one.sensor for one in formats.candidates(self.path(0)) if one.sensor]
        self.sensor = sensors[0] if sensors else type(self).sensor

    def takes_files_in(self, folder: Path) -> bool:
        """Return whether a folder is the root or lies below it, at whatever depth."""
        return self.root.is_dir() and folder.resolve().is_relative_to(self.root.resolve())

    @classmethod
    def matches(cls, root: Path) -> bool:
        """Return whether a folder holds a file with the ending of a scan, or a single file has one."""
        return next(scans_below(root), None) is not None

    @classmethod
    def _find(cls, root: Path) -> list[Path]:
        return natural_order(scans_below(root))

    def sequence_of(self, relative: Path) -> str:
        """Name the folder of a file."""
        return relative.parent.as_posix()

    def recording_of(self, path: Path) -> str:
        """Name a recording by its folder."""
        return unnamed_recording(path)
