"""PandaSet's lidar/NN.pkl.gz: points of two sensors in the world's axes → :class:`Scan` of the turning Pandar64."""

import gzip
import zlib
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from lidargrit.core.errors import DataError, ScanError
from lidargrit.core.files import read_json, remembered
from lidargrit.data.formats import BadPoints, ScanFormat, damaged, first_bytes, read_bytes
from lidargrit.data.formats.shared.pandas_pickle import columns_of_table
from lidargrit.scans.columns import ScanParts, treated_parts
from lidargrit.scans.motion import as_poses
from lidargrit.scans.types import Scan
from lidargrit.scans.undo_motion import Trajectory

_FORMAT = "a frame of PandaSet as it is published: lidar/NN.pkl.gz beside poses.json and timestamps.json"
_FILE_BYTES_AT_MOST, _UNPACKED_BYTES_AT_MOST = 50_000_000, 64_000_000  # a frame has 4 MB, unpacked 8
_COLUMNS = ("x", "y", "z", "i", "t", "d")
_POSES = ("poses.json", "timestamps.json")
_TURNING = 0  # of the column d; 1 is the PandarGT, which looks ahead
# Place and tilt of the Pandar64 in the axes of lidar/poses.json, x to the right and y ahead, which PandaSet does not
# give: fitted to two of its drives, so that rows lie on the sensor's elevations. They agree to 4 mm and 0.02 degrees.
_ORIGIN_M, _TILT_DEG = np.array([0.0008, 0.7805, 1.8572]), (-0.902, 0.036)
_BEFORE_AT_MOST = 0.1  # share of points from before the first pose


class PandasetPkl(ScanFormat):
    """Frames of PandaSet in its own layout: pickled tables, read without pandas and without running code in them.

    Points are stored in the world's axes with the car's motion taken out. They are put back to where the laser saw
    them, by the pose at each point's time, and then have the sensor's axes; labels come from ``annotations/semseg``
    where they are there, in PandaSet's own numbers. Most points of the first frame of a drive are from before its first
    pose, which is extended backwards: rows of a car that turns or brakes lie off there, and a note says so.

    Source:
        Xiao et al., PandaSet: Advanced Sensor Suite Dataset for Autonomous Driving, ITSC 2021.
    """

    title = "PandaSet .pkl.gz (x, y, z, i, t, d of two sensors)"
    suffixes = (".pkl.gz",)
    reflectance = "intensity 0 to 255, divided by 255"
    frame = "the world's axes, the car's motion taken out"
    sensor = "pandar64"
    companion = "poses.json"

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether a file begins as a packed table with the columns of points."""
        try:
            start = zlib.decompressobj(31).decompress(first_bytes(path, 4096), 4096)
        except zlib.error:
            return False
        return all(b"X\x01\x00\x00\x00" + name.encode() in start for name in _COLUMNS)

    @staticmethod
    def read(path: Path, index: int = 0, bad_points: BadPoints = "refuse") -> Scan:
        """Read the points of the turning sensor."""
        columns = _columns(path, _COLUMNS)
        own = columns["d"] == _TURNING
        if not own.any():
            raise ScanError(f"no point of the Pandar64 in {path}", _FORMAT, "leave the file out")
        drive, number = _drive(path)
        times_s = columns["t"][own].astype(np.float64)
        if not np.isfinite(times_s).all() or not drive.covers(times_s):
            raise ScanError(f"times of points in {path} that its poses do not cover", _FORMAT, "download both again")
        world_m = np.stack([columns[axis][own].astype(np.float64) for axis in "xyz"], axis=1)
        turned, place_m = drive.at(times_s)
        xyz_m = _to_sensor(turned.inv().apply(world_m - place_m))
        parts = ScanParts(
            points_xyz_m=torch.from_numpy(xyz_m.astype(np.float32)),
            reflectance=torch.from_numpy(columns["i"][own].astype(np.float32) / 255),
            point_time_s=torch.from_numpy(times_s - drive.times_s[number]),
        )
        if (labels := _labels_of(path)).exists():
            (classes,) = _columns(labels, ("class",)).values()
            if len(classes) != len(own):
                raise ScanError(f"{len(classes)} labels in {labels}", f"{len(own)}, one a point", "download both again")
            parts["label"] = torch.from_numpy(classes[own].astype(np.int64))
        before = float((times_s < drive.times_s[0]).mean())
        note = f"{before:.0%} of the points are from before the first pose of the drive: rows may lie off"
        scan = Scan(**treated_parts(parts, bad_points), source=str(path))
        return replace(scan, notes=(*scan.notes, note)) if before > _BEFORE_AT_MOST else scan

    @staticmethod
    def sidecar_files(path: Path) -> tuple[Path, ...]:
        """Return the poses and times of the drive, and the labels of the frame."""
        return (*map(path.with_name, _POSES), _labels_of(path))


def sensor_poses(folder: Path) -> Trajectory:
    """Return the poses of the turning sensor at the times of the frames, seen from the first, times from 0 on.

    Args:
        folder: folder ``lidar`` of a drive.
    """
    cars = _trajectory(folder)
    pose_from_sensor = np.linalg.inv(_SENSOR_FROM_POSE)
    poses = _SENSOR_FROM_POSE @ np.linalg.inv(cars.poses[0]) @ cars.poses @ pose_from_sensor
    return Trajectory(cars.times_s - cars.times_s[0], poses, cars.source)


def _sensor_from_pose() -> Float64[np.ndarray, "4 4"]:
    """Return the matrix from the axes of the poses to the sensor's, x ahead and y to the left."""
    tilted = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) @ Rotation.from_euler("xy", _TILT_DEG, True).as_matrix()
    return as_poses(tilted, -tilted @ _ORIGIN_M)


_SENSOR_FROM_POSE = _sensor_from_pose()


def _to_sensor(points_m: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    return points_m @ _SENSOR_FROM_POSE[:3, :3].T + _SENSOR_FROM_POSE[:3, 3]


def _labels_of(path: Path) -> Path:
    return path.absolute().parent.parent / "annotations" / "semseg" / path.name


def _drive(path: Path) -> tuple[Trajectory, int]:
    """Return the poses of a frame's drive, and the frame's number among them."""
    try:
        drive = _trajectory(path.parent)
    except DataError as error:
        raise ScanError(error.got, error.wanted, error.cure) from None
    number = path.name.partition(".")[0]
    if not number.isdecimal() or int(number) >= len(drive.times_s):
        raise ScanError(f"{path}, a frame beyond the poses of its drive", _FORMAT, "keep the names of the files")
    return drive, int(number)


@remembered(lambda folder: [folder / name for name in _POSES], at_most=16)
def _trajectory(folder: Path) -> Trajectory:
    cure, source = "download the drive again, and keep its files together", str(folder / "poses.json")
    try:
        poses, times = (read_json(folder / name, list, DataError, _FORMAT, cure) for name in _POSES)
        turns = Rotation.from_quat([[float(one["heading"][key]) for key in "xyzw"] for one in poses]).as_matrix()
        places_m = np.array([[float(one["position"][key]) for key in "xyz"] for one in poses])
        matrices = as_poses(turns, places_m)
        times_s = np.array([float(time) for time in times])
        if len(times_s) != len(matrices) or not (np.isfinite(matrices).all() and np.isfinite(times_s).all()):
            raise ValueError("as many times as poses, all finite")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(f"{source}, which holds no poses ({error!s:.80})", _FORMAT, cure) from None
    return Trajectory(times_s, matrices, source)


def _columns(path: Path, wanted: tuple[str, ...]) -> dict[str, np.ndarray]:
    data = read_bytes(path, _FILE_BYTES_AT_MOST, _FORMAT)
    try:
        with gzip.open(BytesIO(data)) as file:
            unpacked = file.read(_UNPACKED_BYTES_AT_MOST + 1)
        if len(unpacked) > _UNPACKED_BYTES_AT_MOST:
            raise ValueError("more than any frame unpacked")
        columns = columns_of_table(unpacked)
        return {name: columns[name] for name in wanted}
    except Exception as error:  # damaged bytes make the unpickler raise many kinds, for one cause
        raise damaged(path, _FORMAT, error) from None
