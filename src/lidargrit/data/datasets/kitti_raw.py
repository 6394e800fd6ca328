"""KITTI raw: ROOT/YYYY_MM_DD/DRIVE_sync/velodyne_points/data/*.bin → scans of drives, chosen by name."""

from pathlib import Path

from lidargrit.data.datasets.shared.files import FileDataset


class KittiRaw(FileDataset):
    """The synchronised drives of KITTI raw; there is no official split, so drives are chosen by their folder's name.

    Eleven of them are also sequences 00 to 10 of KITTI odometry.
    """

    title = "KITTI raw"
    licence = "CC BY-NC-SA 3.0 (non-commercial)"
    tree = "ROOT/YYYY_MM_DD/YYYY_MM_DD_drive_DDDD_sync/velodyne_points/data/*.bin"
    sensor = "hdl64e_kitti_odometry"
    format = "kitti_bin"
    citation = "Geiger, Lenz, Stiller, Urtasun: Vision meets robotics: the KITTI dataset, IJRR 2013"
    patterns = ("????_??_??/*_sync/velodyne_points/data/*.bin",)

    def sequence_of(self, relative: Path) -> str:
        """Name the drive: "2011_09_26_drive_0001_sync"."""
        return relative.parts[-4]

    def recording_of(self, path: Path) -> str:
        """Name the drive without how it was prepared: "kitti/2011_09_26_drive_0001"."""
        drive = self.sequence_of(path.relative_to(self.root))
        return f"kitti/{drive.removesuffix('_sync').removesuffix('_extract')}"
