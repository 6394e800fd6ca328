"""KITTI-360: ROOT/data_3d_raw/2013_05_28_drive_SSSS_sync/velodyne_points/data/*.bin → scans of 9 long drives."""

from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float64

from lidargrit.core.files import remembered
from lidargrit.data.datasets import SplitScheme
from lidargrit.data.datasets.shared.files import FileDataset
from lidargrit.data.datasets.shared.odometry import calibrated, table
from lidargrit.data.datasets.shared.poses_beside import time_beside
from lidargrit.scans.motion import Motion, as_poses

_CAMERA = "image_00:"
_SAME_DRIVE = {"0018": "0002"}  # its 4,380 scans come before 0000004391, with which 0002 was published


class Kitti360(FileDataset):
    """The raw Velodyne scans of KITTI-360. There is no official split of scans for generation, and no two papers agree.

    To choose a checkpoint without a leak, train on ``train_without_val`` and validate on ``val``; ``train`` is for
    numbers to set beside published ones. All drives, the test drives too, are of one city and one car.
    """

    title = "KITTI-360"
    licence = "CC BY-NC-SA 3.0 (non-commercial)"
    tree = "ROOT/data_3d_raw/2013_05_28_drive_SSSS_sync/velodyne_points/data/*.bin"
    sensor = "hdl64e_kitti_360"
    format = "kitti_bin"
    citation = "Liao, Xie, Geiger: KITTI-360, IEEE PAMI 2022"
    schemes: ClassVar[dict[str, SplitScheme]] = {
        "paper": SplitScheme(
            source="LiDARGen (Zyrianov et al., ECCV 2022), R2DM, R2Flow and LidarGRIT, as their papers say",
            leak="val (0005, which LidarGRIT chooses its VQ-VAE on) lies in train; train_without_val leaves it out.",
            parts={
                "train": ("0003", "0004", "0005", "0006", "0007", "0009", "0010"),
                "train_without_val": ("0003", "0004", "0006", "0007", "0009", "0010"),
                "val": ("0005",),
                "test": ("0000", "0002"),
            },
        ),
        "lidargrit-code": SplitScheme(
            source="hamedhaghighi/LidarGRIT@a3f86e7",
            leak="The VQ-VAE is chosen on 0005, which it trains on; the transformer on 0000, which it is tested on.",
            parts={
                "train": ("0003", "0004", "0005", "0006", "0007", "0009", "0010"),
                "val_tokenizer": ("0005",),
                "val_transformer": ("0000",),
                "test": ("0000", "0002"),
            },
        ),
        "lidargen-code": SplitScheme(
            source="vzyrianov/lidargen, the program",
            leak="It leaves out 0000, and 0001, which was never released: so it trains on 0002, and tests on it.",
            parts={
                "train": ("0002", "0003", "0004", "0005", "0006", "0007", "0009", "0010"),
                "test": ("0000", "0002"),
            },
        ),
        "lidm": SplitScheme(
            source="hancyran/LiDAR-Diffusion@4c94f10, the program",
            leak="It trains on 0000 and 0002, the test drives of all others, and has no test drives of its own.",
            parts={"train": ("0000", "0002", "0004", "0005", "0006", "0007", "0008", "0009", "0010"), "val": ("0003",)},
        ),
    }
    patterns = ("data_3d_raw/2013_05_28_drive_????_sync/velodyne_points/data/*.bin",)

    def motion(self, index: int) -> Motion:
        """Return time and pose of a scan: those of the car in ``data_poses``, and of the sensor on it."""
        path = self.path(index)
        drive = path.parents[2].name
        poses, number = _poses(self.root, drive), int(path.stem) if path.stem.isdecimal() else -1
        if not poses:
            return super().motion(index)
        pose = poses.get(number)
        return Motion(time_beside(path), None if pose is None else torch.from_numpy(pose))

    def sequence_of(self, relative: Path) -> str:
        """Name the drive by its number: "0003"."""
        return relative.parts[-4].removeprefix("2013_05_28_drive_").removesuffix("_sync")

    def recording_of(self, path: Path) -> str:
        """Name the drive; 0018, which the benchmark of perception has, is the beginning of 0002 under other names."""
        drive = self.sequence_of(path.relative_to(self.root))
        return f"{self.public_name()}/{_SAME_DRIVE.get(drive, drive)}"


def _files_of(root: Path, drive: str) -> list[Path]:
    calibration = [root / "calibration" / name for name in ("calib_cam_to_pose.txt", "calib_cam_to_velo.txt")]
    return [root / "data_poses" / drive / "poses.txt", *calibration]


@remembered(_files_of, at_most=16)
def _poses(root: Path, drive: str) -> dict[int, Float64[np.ndarray, "4 4"]]:
    """Return the pose of the sensor at each scan of a drive that has one, by its number; none without the files.

    Source:
        KITTI-360's documentation: poses.txt is of the GPS and IMU, calib_cam_to_pose.txt leads from each camera there,
        and calib_cam_to_velo.txt from camera 0 to the sensor.
    """
    poses, *files = _files_of(root, drive)
    rows = table(poses, 13, "13 numbers in each row: a scan's number and its pose")
    if not len(rows) or not all(file.is_file() for file in files):
        return {}
    pose_from_velo = calibrated(files[0], _CAMERA) @ np.linalg.inv(calibrated(files[1]))
    matrices = rows[:, 1:].reshape(-1, 3, 4)
    poses = as_poses(matrices[..., :3], matrices[..., 3])
    return {int(number): pose @ pose_from_velo for number, pose in zip(rows[:, 0], poses, strict=True)}
