"""Range images as 16-bit PNG, 64 rows high: ROOT/DRIVE/*.png → scans with a ring per point."""

from pathlib import Path

from lidargrit.data.datasets.shared.files import FileDataset, unnamed_recording


class RangeImageFiles(FileDataset):
    """Velodyne range images as recorded in Karlsruhe (KIT/MRT, F. Moosmann), and others of their kind.

    A drive is a subfolder; there are no named splits. An image of 870 columns fills 870 of the sensor's 2048 fine
    columns, and so 109 of the 256 that are kept. To have every pixel of the file, project with 870 columns
    (``--set data.columns=870 data.column_stride=1``).
    """

    title = "range images as PNG"
    licence = "that of your files; the Karlsruhe recordings' publisher states none"
    tree = "ROOT/DRIVE/*.png (16 bit, 64 rows)"
    sensor = "hdl64e_kitti_odometry"
    format = "range_png"
    citation = "that of your files; Moosmann and Stiller: Velodyne SLAM, IV 2011, for the Karlsruhe recordings"
    patterns = ("*/*.png", "*.png")

    def recording_of(self, path: Path) -> str:
        """Name a recording by its folder."""
        return unnamed_recording(path)
