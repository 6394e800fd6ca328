"""Scans of a drive → the path that KISS-ICP makes of them, and how far it is off the poses of the drive."""

from collections.abc import Iterable
from importlib import import_module
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from lidargrit.core.errors import ConfigError

SETTLING_SCANS = 10
"""Scans before the first one whose step counts: KISS-ICP begins at rest, and its first steps are up to 20 cm off."""
INSTALL = "pip install 'lidargrit[odometry]'"
_STANDS_M = 0.3  # that a car moves less in all scans that count
_NO_TIMES_S = np.zeros(0)  # of points: none is moved


class PathErrors(NamedTuple):
    """How far a path is off another one.

    Args:
        steps_m: distance in metres between both, of each step from one scan to the next, once the odometry has settled;
            none where the car stands.
        drift: distance between both at the end of these steps, over the length of the true path; NaN without steps.
    """

    steps_m: list[float]
    drift: float


def path_errors(
    estimated: Float64[np.ndarray, "n 4 4"], true: Float64[np.ndarray, "n 4 4"], settling: int = SETTLING_SCANS
) -> PathErrors:
    """Compare two paths by how each moves, wherever both begin.

    Args:
        estimated, true: pose of each scan, from the sensor's frame to that of its path.
        settling: number of first scans whose steps are left out.

    Source:
        Steps: the relative pose error of Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012,
        its translation, from scan to scan. Drift: KITTI odometry's translational error (Geiger et al., CVPR 2012),
        there over 100 to 800 m, here over what the drive has.
    """
    estimated, true = estimated[settling:], true[settling:]
    length_m = float(np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum())
    if length_m < _STANDS_M:
        return PathErrors([], np.nan)
    steps_m = [_apart_m(estimated[at : at + 2], true[at : at + 2]) for at in range(len(true) - 1)]
    return PathErrors(steps_m, _apart_m(estimated, true) / length_m)


def _apart_m(estimated: Float64[np.ndarray, "n 4 4"], true: Float64[np.ndarray, "n 4 4"]) -> float:
    """Return how far the motions from the first to the last pose of two paths are apart."""
    moves = [np.linalg.inv(path[0]) @ path[-1] for path in (estimated, true)]
    return float(np.linalg.norm((np.linalg.inv(moves[1]) @ moves[0])[:3, 3]))


def kiss_icp_is_there() -> bool:
    """Return whether KISS-ICP can be imported."""
    try:
        import_module("kiss_icp.kiss_icp")
    except ImportError:
        return False
    return True


def path_by_kiss_icp(scans_m: Iterable[Float64[np.ndarray, "_ 3"]]) -> Float64[np.ndarray, "n 4 4"]:
    """Return the pose of each scan in the frame of the first one, by KISS-ICP with its own settings and one thread.

    Args:
        scans_m: points of each scan, in metres; they are taken as they are, without undoing the car's motion.

    Raises:
        ConfigError: KISS-ICP is not installed.

    Source:
        Vizzo et al., KISS-ICP: In Defense of Point-to-Point ICP, RA-L 2023; its package kiss-icp 1.3.0.
    """
    if not kiss_icp_is_there():
        raise ConfigError("no package kiss_icp", "it installed", INSTALL)
    config = import_module("kiss_icp.config").load_config(None)
    config.registration.max_num_threads = 1  # sums in one order: the same path each time
    odometry = import_module("kiss_icp.kiss_icp").KissICP(config)
    poses = []
    for points_m in scans_m:
        odometry.register_frame(points_m, _NO_TIMES_S)
        poses.append(np.array(odometry.last_pose))
    return np.array(poses, dtype=np.float64).reshape(-1, 4, 4)
