"""Logs of py123d (Waymo, nuPlan, PandaSet, ... as its converter writes them): ROOT/SPLIT/LOG/sync.arrow → scans."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lidargrit.core.errors import DataError, ScanError
from lidargrit.data.datasets.shared.library import LibraryDataset
from lidargrit.data.formats import BadPoints, scan_of
from lidargrit.scans.motion import Motion
from lidargrit.scans.types import Scan

_MICROSECONDS = 1e6
_LARGEST_INTENSITY = 255


class Py123d(LibraryDataset):
    """Logs that py123d has converted with its points (``lidar_store_option: binary``); a sequence is a log.

    The LiDAR on the roof is read, or the first if there is none. The library turns points into the vehicle's frame;
    here they are turned back into the sensor's. The sensors differ: name yours with ``data.sensor``, which
    ``lidargrit fit-sensor`` makes.

    Source:
        py123d 0.7 (Apache-2.0).
    """

    title = "Arrow logs of py123d"
    licence = "that of the data set that was converted"
    tree = "ROOT/SPLIT/LOG/sync.arrow with LOG/lidar*.arrow"
    sensor = "hdl64e_kitti_360"
    sensors_differ = True
    citation = "that of the data set that was converted"
    library = "py123d"
    patterns = ("*/*/sync.arrow", "*/*/*/sync.arrow")

    @classmethod
    def open_drive(cls, path: Path) -> "Py123dLog":
        """Open a log."""
        return Py123dLog(path.parent)

    def sequence_of(self, relative: Path) -> str:
        """Name the log by its split and its own name."""
        return relative.parent.as_posix()


class Py123dLog:
    """The LiDAR on the roof of a log, or its first."""

    def __init__(self, folder: Path) -> None:
        split, log = folder.parent, folder.name
        scenes: Any = import_module("py123d.api.scene.arrow.arrow_scene_builder")
        wanted: Any = import_module("py123d.api.scene.scene_filter").SceneFilter(
            split_names=[split.name], log_names=[log]
        )
        executor: Any = import_module("py123d.common.execution.sequential_executor").SequentialExecutor()
        self._refuse_paths(folder)
        (self._log,) = scenes.ArrowSceneBuilder(split.parent, folder).get_scenes(wanted, executor)
        about = self._log.get_lidar_metadatas()
        if not about:
            raise DataError(f"{folder}, a log without a LiDAR", Py123d.tree, "leave it out")
        named = {each.name: each for each in about}
        self._lidar = named.get("LIDAR_TOP") or named[min(named)]
        self._in_vehicle = about[self._lidar].lidar_to_imu_se3.transformation_matrix
        others = sorted(name for name in named if name != self._lidar.name)
        self._source = str(folder)
        self._notes = (f"the LiDAR {self._lidar.name} is read, and not {', '.join(others)}",) if others else ()

    @staticmethod
    def _refuse_paths(folder: Path) -> None:
        """Refuse logs that name files of the data set in place of points: the library would unpickle some of these."""
        opened: Any = import_module("py123d.api.utils.arrow_helper").open_arrow_schema
        for file in folder.glob("lidar*.arrow"):
            if any(field.name.endswith(".data") and str(field.type) == "string" for field in opened(file)):
                cure = "convert it with lidar_store_option: binary"
                raise DataError(f"{file}, which names files in place of points", "a log that holds its points", cure)

    def __len__(self) -> int:
        return int(self._log.number_of_iterations)

    def scan(self, index: int, bad_points: BadPoints) -> Scan:
        """Read one turn, in the frame of the sensor."""
        seen = self._log.get_lidar_at_iteration(index, self._lidar)
        if seen is None:
            raise ScanError(f"scan {index} of {self._source}, which has no points", Py123d.tree, "leave it out")
        known = seen.point_cloud_features or {}
        back = np.linalg.inv(self._in_vehicle)
        xyz_m = seen.point_cloud_3d.astype(np.float64) @ back[:3, :3].T + back[:3, 3]
        intensity, channel, time_us = (known.get(name) for name in ("intensity", "channel", "timestamps"))
        reflectance = None if intensity is None else torch.from_numpy(intensity.astype(np.float32) / _LARGEST_INTENSITY)
        ring = None if channel is None else torch.from_numpy(channel.astype(np.int64))
        begun_us = seen.timestamp.time_us
        time_s = None if time_us is None else torch.from_numpy((time_us.astype(np.int64) - begun_us) / _MICROSECONDS)
        points_xyz_m = torch.from_numpy(xyz_m.astype(np.float32))
        scan = scan_of(points_xyz_m, reflectance, ring, f"{self._source}#{index}", bad_points, point_time_s=time_s)
        return replace(scan, notes=(*scan.notes, *self._notes))

    def motion(self, index: int) -> Motion:
        """Return when a turn began, since the log's first, and the sensor's pose in the world where the log has it."""
        times_us = [self._log.get_timestamp_at_iteration(at).time_us for at in (0, index)]
        vehicle = self._log.get_ego_state_se3_at_iteration(index)
        pose = None if vehicle is None else torch.from_numpy(vehicle.imu_se3.transformation_matrix @ self._in_vehicle)
        return Motion((times_us[1] - times_us[0]) / _MICROSECONDS, pose)
