"""PandaSet: ROOT/NNN/lidar/NN.pkl.gz → scans of the turning one of its two sensors, with labels, times and poses."""

from pathlib import Path

import torch

from lidargrit.data.datasets.shared.files import FileDataset, unnamed_recording
from lidargrit.data.formats.pandaset_pkl import sensor_poses
from lidargrit.scans.motion import Motion


class Pandaset(FileDataset):
    """The 103 drives of PandaSet in its own layout; a sequence is a drive, such as ``001``.

    A frame holds the points of two sensors. A scan is those of the Pandar64, as the laser saw them; its labels have
    PandaSet's own numbers. The folder of one drive is read, too.
    """

    title = "PandaSet"
    licence = "CC BY 4.0"
    tree = "ROOT/NNN/lidar/NN.pkl.gz"
    sensor = "pandar64"
    format = "pandaset_pkl"
    citation = "Xiao et al.: PandaSet: Advanced Sensor Suite Dataset for Autonomous Driving, ITSC 2021"
    patterns = ("*/lidar/*.pkl.gz", "lidar/*.pkl.gz")

    def motion(self, index: int) -> Motion:
        """Return time and pose of a scan, both seen from the first frame of its drive."""
        path = self.path(index)
        known, number = sensor_poses(path.parent), path.name.partition(".")[0]
        if not number.isdecimal() or int(number) >= len(known.times_s):
            return Motion()
        return Motion(float(known.times_s[int(number)]), torch.from_numpy(known.poses[int(number)].copy()))

    def sequence_of(self, relative: Path) -> str:
        """Name the drive of a file: "001"."""
        return relative.parts[-3] if len(relative.parts) > 2 else "."

    def recording_of(self, path: Path) -> str:
        """Name the drive of a file, also where the root is the drive itself."""
        drive = path.resolve().parent.parent.name
        return f"pandaset/{drive}" if drive.isdecimal() else unnamed_recording(path)
