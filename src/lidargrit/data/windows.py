"""Scans with their times and poses → runs of scans of one drive, in which nothing is missing."""

from collections.abc import Sequence
from itertools import pairwise
from statistics import median
from typing import NamedTuple

from lidargrit.core import reporting
from lidargrit.core.errors import printable
from lidargrit.scans.motion import Motion

_GAP = 1.5  # periods between two scans of a drive
_SPEED_AT_MOST_M_PER_S = 60.0
_CURE = "put times.txt and poses.txt beside the scans, as KITTI odometry has them"


class TimedScan(NamedTuple):
    """When and where one scan of a set was made.

    Args:
        name: name of the scan, for messages.
        recording: name of its recording; "" where it is of none.
    """

    name: str
    recording: str
    motion: Motion


def drives_in(scans: Sequence[TimedScan], with_poses: bool = True) -> list[list[int]]:
    """Return the drives among scans, each as numbers of scans in order of time, and report where one ends early.

    A drive ends where the time does not rise, after a gap of more than one and a half periods of its recording, and
    after a jump of more than 60 m/s. Scans whose time is not known are in none.

    Args:
        scans: scans of a set in their order.
        with_poses: whether scans without a pose are in no drive either.
    """
    lacking, recordings = list[str](), dict[str, list[int]]()
    for number, scan in enumerate(scans):
        if scan.motion.time_s is None or (with_poses and scan.motion.pose is None):
            lacking.append(scan.name)
        else:
            recordings.setdefault(scan.recording, []).append(number)
    drives, ends = list[list[int]](), dict[str, list[str]]()
    for numbers in recordings.values():
        steps_s = [_step_s(scans[one].motion, scans[other].motion) for one, other in pairwise(numbers)]
        period_s = median([step_s for step_s in steps_s if step_s > 0] or [0.0])
        drives.append(numbers[:1])
        for (one, other), step_s in zip(pairwise(numbers), steps_s, strict=True):
            why = _end(scans[one].motion, scans[other].motion, step_s, period_s)
            if why:
                ends.setdefault(why, []).append(scans[other].name)
                drives.append([])
            drives[-1].append(other)
    if with_poses and lacking:
        what = "scan has" if len(lacking) == 1 else "scans have"
        told = f"{len(lacking)} {what} no time or no pose, such as {printable(lacking[0])}, and so no past"
        reporting.message(f"{told}; {_CURE}")
    if ends:
        counted = [f"{why} ({len(names)} times, first before {printable(names[0])})" for why, names in ends.items()]
        reporting.message(f"drives end at {', '.join(counted)}")
    return drives


def _step_s(one: Motion, other: Motion) -> float:
    return (other.time_s or 0.0) - (one.time_s or 0.0)


def _end(one: Motion, other: Motion, step_s: float, period_s: float) -> str:
    """Return why a drive ends between two scans, in words; "" if it goes on."""
    if step_s <= 0:
        return "a repeated time" if step_s == 0 else "a time before the last"
    if step_s > _GAP * period_s:
        return f"a gap above {_GAP:g} periods of {period_s:.2g} s"
    if one.pose is not None and other.pose is not None:
        moved_m = float((other.pose[:3, 3] - one.pose[:3, 3]).norm())
        if moved_m > _SPEED_AT_MOST_M_PER_S * step_s:
            return f"a jump above {_SPEED_AT_MOST_M_PER_S:g} m/s"
    return ""
