"""NVIDIA NCore 4: ROOT/NAME.ncore4*.zarr.itar → scans of the first LiDAR with rows, times and poses."""

from dataclasses import replace
from glob import escape
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float64

from lidargrit.core.determinism import natural_order
from lidargrit.core.errors import DataError
from lidargrit.data.datasets.shared.library import LibraryDataset
from lidargrit.data.formats import BadPoints, scan_of
from lidargrit.scans.motion import Motion
from lidargrit.scans.types import Scan

if TYPE_CHECKING:
    from types import ModuleType

_MARK = ".ncore4"  # between the name of a drive and that of a group of its files
_MICROSECONDS = 1e6


class Ncore(LibraryDataset):
    """Drives of NVIDIA's NCore 4, such as what its converters write; a sequence is a drive.

    The first LiDAR of each is read, first returns only. A point lies where its ray met something when it was fired, and
    its ring is the row that the sensor's model gives it. The sensors differ: name yours with ``data.sensor``, which
    ``lidargrit fit-sensor`` makes.
    """

    title = "NVIDIA NCore 4"
    licence = "that of your files"
    tree = "ROOT/NAME.ncore4*.zarr.itar, or one folder deeper"
    sensor = "os1_128"
    sensors_differ = True
    citation = "none: your recordings"
    library = "nvidia-ncore"
    patterns = ("*.ncore4*.zarr.itar", "*/*.ncore4*.zarr.itar")

    def _find(self) -> list[Path]:
        """Return one file of each drive, which may have several."""
        first = {(path.parent, _drive_of(path)): path for path in reversed(super()._find())}
        return natural_order(first.values())

    @classmethod
    def open_drive(cls, path: Path) -> "NcoreDrive":
        """Open all files of a drive."""
        return NcoreDrive(path)

    def sequence_of(self, relative: Path) -> str:
        """Name the drive."""
        return (relative.parent / _drive_of(relative)).as_posix()


def _drive_of(path: Path) -> str:
    return path.name.partition(_MARK)[0]


class NcoreDrive:
    """The first LiDAR of a drive, of one file of it."""

    def __init__(self, path: Path) -> None:
        ncore: ModuleType = import_module("ncore.data.v4")
        files = natural_order(path.parent.glob(f"{escape(_drive_of(path))}{_MARK}*.zarr.itar"))
        reader: Any = ncore.SequenceComponentGroupsReader(files, max_threads=1)
        drive: Any = ncore.SequenceLoaderV4(reader, masks_component_group_name=None, cuboids_component_group_name=None)
        if not drive.lidar_ids:
            raise DataError(f"{path}, a drive without a LiDAR", Ncore.tree, "leave it out")
        chosen, *others = sorted(drive.lidar_ids)
        self._lidar, self._poses, self._source = drive.get_lidar_sensor(chosen), drive.pose_graph, str(path)
        self._notes = (f"the LiDAR {chosen!r} is read, and not {', '.join(map(repr, others))}",) if others else ()

    def __len__(self) -> int:
        return int(self._lidar.frames_count)

    def scan(self, index: int, bad_points: BadPoints) -> Scan:
        """Read the first returns of one turn."""
        lidar, begun_us = self._lidar, int(self._lidar.frames_timestamps_us[index, 0])
        returned = lidar.get_frame_ray_bundle_return_valid_mask(index)
        range_m = lidar.get_frame_ray_bundle_return_distance_m(index)[returned]
        xyz_m = lidar.get_frame_ray_bundle_direction(index)[returned] * range_m[:, None]
        fired_us = lidar.get_frame_ray_bundle_timestamp_us(index)[returned].astype(np.int64) - begun_us
        element = lidar.get_frame_ray_bundle_model_element(index)  # row and column
        ring = None if element is None else torch.from_numpy(element[returned, 0].astype(np.int64))
        reflectance = torch.from_numpy(lidar.get_frame_ray_bundle_return_intensity(index)[returned])
        source, time_s = f"{self._source}#{index}", torch.from_numpy(fired_us / _MICROSECONDS)
        scan = scan_of(torch.from_numpy(xyz_m), reflectance, ring, source, bad_points, point_time_s=time_s)
        return replace(scan, notes=(*scan.notes, *self._notes))

    def motion(self, index: int) -> Motion:
        """Return when a turn began, since the drive's first, and the sensor's pose in the world then."""
        times_us = self._lidar.frames_timestamps_us
        pose: Float64[np.ndarray, "4 4"] = self._poses.evaluate_poses(
            self._lidar.sensor_id, "world", times_us[index, :1]
        )[0].astype(np.float64)
        return Motion(float(times_us[index, 0] - times_us[0, 0]) / _MICROSECONDS, torch.from_numpy(pose))
