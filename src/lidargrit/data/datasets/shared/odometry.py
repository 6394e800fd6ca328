"""The files of one KITTI sequence, ``times.txt``, ``poses.txt``, ``calib.txt`` ⇄ when and where each scan was made."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from lidargrit.core.errors import ConfigError, DataError
from lidargrit.core.files import read_text, remembered, write_text
from lidargrit.scans.motion import Motion, as_poses

# KITTI's poses are those of its left camera: x right, y down, z forward. Ours sits in the sensor itself.
_CAMERA_AXES = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
_POSE = "12 finite numbers in each row, the first three rows of a pose"


def _files_of(sequence: Path) -> list[Path]:
    beside = sequence.parent.parent / "poses" / f"{sequence.name}.txt"  # as KITTI itself has them
    return [*(sequence / name for name in ("times.txt", "calib.txt", "poses.txt")), beside]


@remembered(_files_of)
def motions(sequence: Path) -> tuple[Motion, ...]:
    """Return time and pose of every scan of a sequence, by the number of its file.

    Poses of KITTI are those of its left camera; ``Tr`` of ``calib.txt`` leads from the sensor to that camera. Without
    that file poses are the sensor's own.

    Args:
        sequence: folder that holds the files; a time or pose without its files is unknown.

    Source:
        Geiger et al., CVPR 2012, readme.txt of the odometry benchmark's development kit.
    """
    times, calibration, own, beside = _files_of(sequence)
    times_s = table(times, 1, "one finite number of seconds in each row")[:, 0]
    if bool((np.diff(times_s) <= 0).any()):
        raise DataError(f"times that do not rise in {times}", "rising seconds", "restore the file")
    cameras = table(own if own.exists() else beside, 12, _POSE).reshape(-1, 3, 4)
    poses = as_poses(cameras[..., :3], cameras[..., 3])
    if len(poses):
        camera_from_sensor = calibrated(calibration, "Tr:") if calibration.exists() else np.eye(4)
        poses = np.linalg.inv(camera_from_sensor) @ poses @ camera_from_sensor
    count = max(len(times_s), len(poses))
    return tuple(
        Motion(
            float(times_s[number]) if number < len(times_s) else None,
            torch.from_numpy(poses[number]) if number < len(poses) else None,
        )
        for number in range(count)
    )


def calibrated(path: Path, name: str = "") -> Float64[np.ndarray, "4 4"]:
    """Return the matrix from one sensor to another in the row of a file that begins with a name, or in its only row."""
    rows = [line.removeprefix(name) for line in _lines(path) if line.startswith(name) and line.strip()]
    told = f" {name!r}" * bool(name)
    found = _numbers(rows, 12, path, f"a row{told} with {_POSE}")
    if len(found) != 1 or abs(np.linalg.det(found.reshape(3, 4)[:, :3])) < 0.5:  # a rotation has 1
        raise DataError(f"{path} without a pose{told}", "that of one sensor seen from another", "restore the file")
    pose = found.reshape(3, 4)
    return as_poses(pose[:, :3], pose[:, 3])


def table(path: Path, columns: int, wanted: str) -> Float64[np.ndarray, "n columns"]:
    """Return the rows of a file of numbers between blanks, without comments; none where there is no such file."""
    rows = [line for line in _lines(path) if line.strip() and not line.lstrip().startswith("#")]
    return _numbers(rows, columns, path, wanted)


def _numbers(rows: list[str], columns: int, path: Path, wanted: str) -> Float64[np.ndarray, "n columns"]:
    try:
        found = np.array([[float(word) for word in row.split()] for row in rows]).reshape(len(rows), columns)
    except ValueError:
        raise DataError(f"a row of {path} with something else", wanted, "restore the file") from None
    if not np.isfinite(found).all():
        raise DataError(f"a number of {path} that is not finite", wanted, "restore the file")
    return found


def _lines(path: Path) -> list[str]:
    """Return the lines of a file; none where there is no such file."""
    try:
        return read_text(path).splitlines() if path.exists() else []
    except ConfigError as error:
        raise DataError(error.got, error.wanted, error.cure) from None


def write_motions(
    out: Path, sequence: str, poses: Sequence[Float64[np.ndarray, "4 4"]], times_s: Sequence[float] = ()
) -> None:
    """Write the poses of a sequence in KITTI's form with the calibration they need, and the times of its scans.

    Args:
        out: folder of the tree; poses lie in ``poses/SS.txt``, where KITTI's own tools look, too.
        sequence: name of the sequence.
        poses: matrix of each scan from the sensor's frame to that of the drive; none where they are not known.
        times_s: time of each scan in seconds; none of scans that are no drive.
    """
    folder = out / "sequences" / sequence
    if times_s:
        write_text(folder / "times.txt", "".join(f"{time_s:.9f}\n" for time_s in times_s))
    if len(poses):
        lines = "".join(f"{_row(_CAMERA_AXES @ pose @ _CAMERA_AXES.T)}\n" for pose in poses)
        calibration = [f"P{camera}: {_row(np.eye(4))}" for camera in range(4)] + [f"Tr: {_row(_CAMERA_AXES)}"]
        write_text(out / "poses" / f"{sequence}.txt", lines)
        write_text(folder / "calib.txt", "".join(f"{line}\n" for line in calibration))
        write_text(folder / "poses.txt", lines)  # last: it says that the others are there


def num_poses(out: Path, sequence: str) -> int:
    """Return how many poses of a sequence of a tree are there."""
    return len(_lines(out / "sequences" / sequence / "poses.txt"))


def _row(matrix: Float64[np.ndarray, "4 4"]) -> str:
    """Return the first three rows in as many digits as lead back to the same numbers."""
    return " ".join(f"{value:.16e}" for value in matrix[:3].ravel())
