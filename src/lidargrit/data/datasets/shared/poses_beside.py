"""A file of a scan → when and where it was made, by files of times and poses in the folders above it."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from lidargrit.core import reporting
from lidargrit.core.determinism import natural_order
from lidargrit.core.errors import ConfigError, DataError, printable
from lidargrit.core.files import read_text, remembered
from lidargrit.data.datasets.shared.odometry import motions
from lidargrit.scans.motion import Motion

_FOLDERS_ABOVE = 3  # of velodyne_points/data/0000000000.bin, the drive
_TUM_COLUMNS = 8  # time in s, x, y, z in m, and a quaternion


def motion_beside(path: Path) -> Motion:
    """Return time and pose of a scan by ``times.txt`` and ``poses.txt`` of its folder, or of one above it.

    Row n is that of the n-th scan of the folder where there are as many rows as scans, else that of scan number n.
    Times may also be those of ``timestamps.txt``, as KITTI raw has them.
    """
    for folder in path.parents[:_FOLDERS_ABOVE]:
        has_poses = (folder / "poses.txt").is_file() and not _is_trajectory(folder / "poses.txt")
        if has_poses or (folder / "times.txt").is_file():
            known = motions(folder)
            places = _places(path.parent, path.suffix)
            number = places.get(path.name, -1)
            if len(known) != len(places) and path.stem.isdecimal():
                number = int(path.stem)
            found = known[number] if 0 <= number < len(known) else Motion()
            return found if found.time_s is not None else found._replace(time_s=time_beside(path))
    return Motion(time_beside(path))


def time_beside(path: Path) -> float | None:
    """Return the time of a scan in seconds since the first of its drive, by ``timestamps.txt`` beside its folder."""
    times_s = _timestamps_s(path.parent.parent / "timestamps.txt")
    number = int(path.stem) if path.stem.isdecimal() else len(times_s)
    return float(times_s[number]) if number < len(times_s) else None


@remembered(lambda path: [path])
def _is_trajectory(path: Path) -> bool:
    """Return whether a file has TUM's rows of a time and a pose, which are of no scan in particular; tell it once."""
    rows = (row for row in read_text(path).splitlines() if row.strip() and not row.lstrip().startswith("#"))
    if len(next(rows, "").split()) != _TUM_COLUMNS:
        return False
    cure = "KITTI's 12 numbers in a row for each scan would be; export --undo-motion takes it as it is"
    reporting.message(f"{printable(str(path))} has poses in TUM's form, which are not taken as those of scans: {cure}")
    return True


@remembered(lambda folder, suffix: [folder])
def _places(folder: Path, suffix: str) -> dict[str, int]:
    files = natural_order(path for path in folder.glob(f"*{suffix}") if path.is_file())
    return {file.name: place for place, file in enumerate(files)}


@remembered(lambda path: [path])
def _timestamps_s(path: Path) -> Float64[np.ndarray, "n"]:
    wanted = "a row such as 2011-09-26 13:02:25.951199337 for each scan"
    try:
        rows = read_text(path).split("\n") if path.is_file() else []
        times = np.array([row.strip() for row in rows if row.strip()], dtype="datetime64[ns]")
        if np.isnat(times).any():  # which NumPy reads as a time
            raise ValueError
    except (ConfigError, ValueError):
        raise DataError(f"{path} with a row that is no time", wanted, "restore the file") from None
    return (times - times[:1]) / np.timedelta64(1, "s") if len(times) else np.zeros(0)
