"""Poses of a recording: a folder of KITTI's poses.txt and times.txt, or a file in TUM's form → :class:`Trajectory`."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lidargrit.core.errors import DataError
from lidargrit.core.files import read_text
from lidargrit.data.datasets.shared.odometry import motions, table
from lidargrit.scans.motion import as_poses
from lidargrit.scans.undo_motion import Trajectory

_KITTI_COLUMNS = 12
_TUM = "rows of 8 numbers: time in s, x, y, z in m, and a quaternion qx, qy, qz, qw"


def read_trajectory(path: Path) -> Trajectory:
    """Read the poses of a sensor over time.

    Args:
        path: folder with ``poses.txt``, ``times.txt`` and ``calib.txt`` as a sequence of KITTI odometry has them; or a
            file of rows ``time x y z qx qy qz qw``, poses of the lidar itself, as evo, KISS-ICP and other odometries
            write them.

    Source:
        Geiger et al., CVPR 2012 (KITTI); Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012.
    """
    if path.is_dir():
        known = [one for one in motions(path) if one.time_s is not None and one.pose is not None]
        times_s = np.array([one.time_s for one in known], dtype=np.float64)
        poses = np.array([one.pose.numpy() for one in known if one.pose is not None]).reshape(-1, 4, 4)
        return Trajectory(times_s, poses, str(path))
    if not path.is_file():
        wanted = f"a folder with poses.txt, times.txt and calib.txt, or a file of {_TUM}"
        raise DataError(f"{path}, which is not there", wanted, "check the path")
    if len(read_text(path).partition("\n")[0].split()) == _KITTI_COLUMNS:
        wanted = f"the folder that holds it beside times.txt, or {_TUM}"
        raise DataError(f"{path}, which has KITTI's 12 numbers in a row and no times", wanted, f"name {path.parent}")
    rows = table(path, 8, _TUM)
    if not bool((np.abs(np.linalg.norm(rows[:, 4:], axis=1) - 1) < 0.01).all()):
        raise DataError(f"a quaternion of {path} whose length is not 1", _TUM, "restore the file")
    return Trajectory(rows[:, 0], as_poses(Rotation.from_quat(rows[:, 4:]).as_matrix(), rows[:, 1:4]), str(path))
