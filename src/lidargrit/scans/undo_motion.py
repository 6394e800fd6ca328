"""A scan whose points have times, and the poses of its sensor → the scan as if the sensor had stood still."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation
from torch import Tensor

from lidargrit.core.errors import DataError, ScanError
from lidargrit.scans.types import Scan

_BEYOND_S = 0.2  # that the first and last pose are carried on for: two revolutions at 10 Hz
_SCAN_S = 2.0  # that no revolution lasts
_ROTATION = 1e-3  # by which numbers of a file may miss an orthonormal matrix


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The poses of a sensor over time; between two of them it turns and moves evenly.

    Args:
        times_s: times in seconds, rising.
        poses: matrix of each time, from the sensor's frame to that of the recording, in metres.
    """

    times_s: Float64[np.ndarray, "m"]
    poses: Float64[np.ndarray, "m 4 4"]
    source: str = "the trajectory"

    def __post_init__(self) -> None:
        if len(self.times_s) < 2 or bool((np.diff(self.times_s) <= 0).any()):
            got = f"{len(self.times_s)} poses in {self.source}, or times that do not rise"
            raise DataError(got, "at least two, in order of time", "restore the file")
        turns = self.poses[:, :3, :3]
        apart = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max()
        if not (apart < _ROTATION and bool((np.linalg.det(turns) > 0).all())):
            raise DataError(f"a pose of {self.source} that is no rotation", "rotations and places", "restore the file")

    @cached_property
    def _steps_rad(self) -> Float64[np.ndarray, "k 3"]:
        """Turn from each pose to the next, as an axis times its angle."""
        turns = Rotation.from_matrix(self.poses[:, :3, :3])
        return (turns[:-1].inv() * turns[1:]).as_rotvec()

    def covers(self, times_s: Float64[np.ndarray, "n"]) -> bool:
        """Return whether the sensor's pose is known at all times, or within two revolutions of one that is."""
        return bool((times_s >= self.times_s[0] - _BEYOND_S).all() and (times_s <= self.times_s[-1] + _BEYOND_S).all())

    def at(self, times_s: Float64[np.ndarray, "n"]) -> tuple[Rotation, Float64[np.ndarray, "n 3"]]:
        """Return orientation and place at some times.

        Source:
            Shoemake, Animating Rotation with Quaternion Curves, SIGGRAPH 1985: spherical linear interpolation, here by
            the axis and the angle of each step.
        """
        before = np.clip(np.searchsorted(self.times_s, times_s, side="right") - 1, 0, len(self.times_s) - 2)
        begun_s, ended_s = self.times_s[before], self.times_s[before + 1]
        share = ((times_s - begun_s) / (ended_s - begun_s))[:, None]
        place, turns = self.poses[:, :3, 3], Rotation.from_matrix(self.poses[before, :3, :3])
        turned = turns * Rotation.from_rotvec(share * self._steps_rad[before])
        return turned, place[before] + share * (place[before + 1] - place[before])


class Still(NamedTuple):
    """A scan without the motion of its sensor.

    Args:
        scan: scan whose points are all seen from one pose.
        moved_m: distance that each point was moved, in metres.
    """

    scan: Scan
    moved_m: Float64[np.ndarray, "n"]

    @property
    def told(self) -> str:
        """How far points moved, in words."""
        return f"points moved by {np.median(self.moved_m):.3f} m in the median, {self.moved_m.max():.3f} m at most"


@dataclass(frozen=True, eq=False)
class UndoMotion:
    """What moves every point to where the sensor would have measured it from one pose.

    That pose is the one at the scan's own time, and at the time of its first point where the scan has none. Where the
    scan has a time, points below two seconds are timed from there; all others are on the clock of the poses.

    Args:
        trajectory: poses of the sensor during the recording.
    """

    trajectory: Trajectory

    def identity(self) -> dict[str, str]:
        """Return entries of a manifest by which its scans are told from others."""
        return {"motion_undone_by": self.trajectory.source}

    def pose(self, pose: Float64[Tensor, "4 4"] | None) -> Float64[Tensor, "4 4"] | None:
        """Return the pose of a scan without the motion: its own."""
        return pose

    def __call__(self, scan: Scan) -> Still:
        """Return a scan without the motion."""
        if scan.point_time_s is None:
            wanted = (
                "points with times: a column time, t or timestamp, as Velodyne's, Ouster's or Hesai's drivers write"
            )
            raise ScanError(f"{scan.source}, whose points have no times", wanted, "leave --undo-motion out")
        times_s, to_s = self._on_clock(scan, scan.point_time_s)
        turned, moved = self.trajectory.at(times_s)
        now, here = self.trajectory.at(np.array([to_s]))
        points_xyz_m = scan.points_xyz_m.double().numpy()
        still = now[0].inv().apply(turned.apply(points_xyz_m) + moved - here)
        moved_m = np.linalg.norm(still - points_xyz_m, axis=1)
        return Still(replace(scan, points_xyz_m=torch.from_numpy(still).float(), rows=None), moved_m)

    def _on_clock(self, scan: Scan, point_time_s: Float[Tensor, "n"]) -> tuple[Float64[np.ndarray, "n"], float]:
        """Return the times of points, and that of the pose they are brought to, on the clock of the poses."""
        times_s, known, own_s = point_time_s.numpy(), self.trajectory, scan.time_s
        if own_s is not None and np.abs(times_s).max() < _SCAN_S:
            if known.covers(own_s + times_s):
                return own_s + times_s, own_s
        elif known.covers(times_s):
            has_own = own_s is not None and known.covers(np.array([own_s]))
            return times_s, own_s if own_s is not None and has_own else float(times_s.min())
        first, last = known.times_s[0], known.times_s[-1]
        at = f"{times_s.min():.3f} to {times_s.max():.3f} s"
        got = f"points of {at} in {scan.source}{'' if scan.time_s is None else f', a scan at {scan.time_s:.3f} s'}"
        raise ScanError(got, f"times within the poses of {known.source}, {first:.3f} to {last:.3f} s", "give its poses")
