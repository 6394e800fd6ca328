"""Argoverse 2 .feather: the points of two VLP-32C ⇄ :class:`Scan` of one of them, with a ring per point."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from lidargrit.core.errors import DataError, OutputError, ScanError, first_words
from lidargrit.core.files import atomic_path, remembered
from lidargrit.data.formats import BadPoints, ScanFormat, first_bytes, read_bytes, scan_of
from lidargrit.scans.motion import as_poses
from lidargrit.scans.point_times import point_times
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import Scan

_LASERS = 32  # of each sensor: 0 to 31 are those of the upright one, 32 to 63 those of the other
_FILE_BYTES_AT_MOST = 100_000_000  # a sweep has 1 MB
_MEMORY_BYTES_AT_MOST = 200_000_000  # what a file's header says that it unpacks to; a sweep has 1.2 MB
_NEAR_M = 2.0  # elevations of nearer points are too coarse to order lasers by: coordinates are half precision
_COLUMNS = ("x", "y", "z", "intensity", "laser_number")
_FORMAT = f"an Arrow feather file with the columns {', '.join(_COLUMNS)}"
_CURE = "download it again, or convert it"
_POSE_COLUMNS = ("qx", "qy", "qz", "qw", "tx_m", "ty_m", "tz_m")
_ANY = "any.feather"  # for what is the same of all sweeps of a log
_LENGTH_OFF = 0.01  # of a quaternion from 1
_NAMES = ("up_lidar", "down_lidar")
# The poses that the data set's own guide prints as its example, in the order of the columns above.
_NOMINAL = {
    "up_lidar": (0.0, 0.0, -0.002848, 0.999996, 1.350180, 0.0, 1.640420),
    "down_lidar": (-0.994497, 0.104767, 0.000243, -0.000089, 1.355162, 0.000133, 1.565252),
}


class ArgoverseFeather(ScanFormat):
    """Sweeps of Argoverse 2: the points of two sensors, one upside down, in the frame of the car.

    One range image has one sensor's rays, so a file holds two scans: number 0 of the upright sensor and number 1 of
    the one below it. Both have their sensor's origin and axis, with x towards the car's front and z up; rows of the
    second run from +25 down to -15 degrees, those of a VLP-32C turned over. Poses are read from
    ``calibration/egovehicle_SE3_sensor.feather`` of the log; without it they are the published example's, which is
    exact to 0.03 degrees for the upright sensor of another log, and 0.1 to 0.3 degrees off for the lower one.

    Laser numbers follow the elevation in some logs and not in others, so that rings are counted by the median
    elevation of each laser. Coordinates are half precision: 3 cm at 50 m. They are corrected for the car's motion.

    Source:
        Wilson et al., Argoverse 2, NeurIPS 2021; the guides of its sensor and lidar data sets, which
        print the poses and the columns (argoverse/av2-api).
    """

    title = "Argoverse 2 .feather (x, y, z, intensity, laser of two VLP-32C)"
    suffixes = (".feather",)
    reflectance = "intensity 0 to 255, divided by 255"
    frame = "the car's: x forward, y left, z up, origin at its rear axle"
    sensor = "vlp32c"
    keeps = ("reflectance", "ring")
    several = True
    sensors = 2
    extra = "argoverse"

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether a file begins as an Arrow file."""
        return first_bytes(path, 8) == b"ARROW1\0\0"

    @staticmethod
    def count(path: Path) -> int:
        """Count the sensors."""
        return len(_NAMES)

    @staticmethod
    @np.errstate(invalid="ignore", over="ignore")  # scan_of refuses or drops what comes of it
    def read(path: Path, index: int = 0, bad_points: BadPoints = "refuse") -> Scan:
        """Read the scan of the upright sensor (0) or of the one upside down (1)."""
        name = _NAMES[index]
        columns = _columns(path, _COLUMNS, read_bytes(path, _FILE_BYTES_AT_MOST, _FORMAT), may_have=("offset_ns",))
        laser = columns["laser_number"].astype(np.int64) - _LASERS * index
        own = (laser >= 0) & (laser < _LASERS)
        if not own.any():
            raise ScanError(f"no point of {name} in {path}", "points of both sensors", "leave the file out")
        car_m = np.stack([columns[axis][own].astype(np.float64) for axis in "xyz"], axis=1)
        axes, origin_m = _pose(path, name)
        xyz_m = (car_m - origin_m) @ axes
        xyz_m[~car_m.any(axis=1)] = 0  # a placeholder for no return stays one
        fired = {name: values[own] for name, values in columns.items() if name == "offset_ns"}
        times_s, _ = point_times(fired, torch.ones(int(own.sum()), dtype=torch.bool))
        return scan_of(
            torch.from_numpy(xyz_m.astype(np.float32)),
            torch.from_numpy(columns["intensity"][own].astype(np.float32) / 255),
            torch.from_numpy(_rings(xyz_m, laser[own], turned_over=index == 1)),
            str(path),
            bad_points,
            point_time_s=times_s,
        )

    @staticmethod
    def sidecar_files(path: Path) -> tuple[Path, ...]:
        """Return the calibration of the file's log."""
        return (path.absolute().parent.parent.parent / "calibration" / "egovehicle_SE3_sensor.feather",)

    @classmethod
    def write(cls, path: Path, scan: Scan) -> None:
        """Write a scan of 32 rings as a sweep of the upright sensor at its published pose."""
        if scan.ring is None or not 0 <= int(scan.ring.min()) <= int(scan.ring.max()) < _LASERS:
            raise OutputError(
                f"{scan.source}, whose points have {'no' if scan.ring is None else 'other'} rings",
                "rings from 0 to 31, those of a VLP-32C",
                "choose another format, such as bin or ply",
            )
        try:
            import pyarrow as pa  # noqa: PLC0415  an optional part
            from pyarrow import feather  # noqa: PLC0415
        except ImportError:
            raise OutputError(f"no pyarrow to write {path}", "it installed", _install()) from None
        axes, origin_m = _axes_and_origin(_NOMINAL["up_lidar"])
        car_m = (scan.points_xyz_m.double().numpy() @ axes.T + origin_m).astype(np.float16)
        reflectance = torch.zeros(len(scan)) if scan.reflectance is None else scan.reflectance
        table = {
            **{axis: car_m[:, column] for column, axis in enumerate("xyz")},
            "intensity": (255 * reflectance).round().numpy().astype(np.uint8),
            "laser_number": scan.ring.numpy().astype(np.uint8),
            "offset_ns": np.zeros(len(scan), np.int32),
        }
        with atomic_path(path) as temporary:
            feather.write_feather(pa.table(table), str(temporary))


def _install() -> str:
    return "pip install 'lidargrit[argoverse]'"


def _rings(
    xyz_m: Float64[np.ndarray, "n 3"], laser: Int64[np.ndarray, "n"], turned_over: bool
) -> Int64[np.ndarray, "n"]:
    """Count rings from the top by the median elevation of each laser, which need not be numbered in that order.

    Points that are no returns have no say in it, and get ring 0.
    """
    good = np.isfinite(xyz_m).all(axis=1) & xyz_m.any(axis=1)
    points_m, laser_of = xyz_m[good], laser[good]
    elevation_rad = np.arctan2(points_m[:, 2], np.hypot(points_m[:, 0], points_m[:, 1]))
    far = np.linalg.norm(points_m, axis=1) > _NEAR_M
    lasers = np.unique(laser_of)
    points_of = [(laser_of == one) & (far | ~far[laser_of == one].any()) for one in lasers]
    usual = np.array([np.median(elevation_rad[points]) for points in points_of])
    if len(lasers) == _LASERS:
        order = (-usual).argsort(kind="stable").argsort()
    else:  # some lasers saw nothing at all: those that did are told by the sensor's table
        table = load_sensor("vlp32c").elevation_rad[:, 0].double().numpy()
        table = -table[::-1] if turned_over else table
        order = np.abs(usual[:, None] - table).argmin(axis=1)
    ring = np.zeros(len(laser), dtype=np.int64)
    ring[good] = order[np.searchsorted(lasers, laser_of)]
    return ring


def _pose(path: Path, name: str) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
    """Return the pose of a sensor in the car, from the log's calibration if the file lies in a log that has one."""
    (calibration,) = ArgoverseFeather.sidecar_files(path)
    if not calibration.is_file():
        return _axes_and_origin(_NOMINAL[name])
    wanted = f"the columns sensor_name, {', '.join(_POSE_COLUMNS)}"
    data = read_bytes(calibration, _FILE_BYTES_AT_MOST, wanted)
    columns = _columns(calibration, ("sensor_name", *_POSE_COLUMNS), data)
    rows = np.flatnonzero(columns["sensor_name"] == name)
    pose = [float(columns[column][rows[0]]) for column in _POSE_COLUMNS] if len(rows) else [0.0]
    is_unit = np.isfinite(pose).all() and abs(np.linalg.norm(pose[:4]) - 1) < _LENGTH_OFF
    if not (is_unit and abs(_up(pose)[2]) > 0.5):
        raise ScanError(f"no pose of {name} on a car in {calibration}", f"{wanted}, with a unit quaternion", _CURE)
    return _axes_and_origin(pose)


def sensor_poses(path: Path) -> dict[int, Float64[np.ndarray, "4 4"]]:
    """Return the poses of the upright sensor in the city by the times of sweeps in nanoseconds; none without the file.

    Args:
        path: sweep of the log.

    Raises:
        DataError: the file is damaged, or that of the sensors' places in the car.
    """
    return _sensor_poses(path.absolute().parent)


def _pose_files(sweeps: Path) -> tuple[Path, ...]:
    return sweeps.parents[1] / "city_SE3_egovehicle.feather", *ArgoverseFeather.sidecar_files(sweeps / _ANY)


@remembered(_pose_files)
def _sensor_poses(sweeps: Path) -> dict[int, Float64[np.ndarray, "4 4"]]:
    poses, *_ = _pose_files(sweeps)
    if not poses.is_file():
        return {}
    try:
        data = read_bytes(poses, _FILE_BYTES_AT_MOST, "poses of the car")
        columns = _columns(poses, ("timestamp_ns", *_POSE_COLUMNS), data)
        own = _pose(sweeps / _ANY, _NAMES[0])
    except ScanError as error:
        raise DataError(error.got, error.wanted, error.cure) from None
    numbers = np.stack([columns[name] for name in _POSE_COLUMNS], axis=1).astype(np.float64)
    lengths = np.linalg.norm(numbers[:, :4], axis=1)
    if not (np.isfinite(numbers).all() and bool((np.abs(lengths - 1) < _LENGTH_OFF).all())):
        raise DataError(f"{poses}, with a pose that is none", "unit quaternions and places in metres", _CURE)
    found = as_poses(Rotation.from_quat(numbers[:, :4]).as_matrix(), numbers[:, 4:]) @ as_poses(*own)
    return dict(zip(columns["timestamp_ns"].tolist(), found, strict=True))


def _axes_and_origin(pose: Any) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
    """Return a sensor's axes as columns, z up and x as far to the car's front as z allows, and its origin."""
    up = _up(pose)
    up = np.copysign(1.0, up[2]) * up  # one of the sensors hangs upside down
    left = np.cross(up, (1.0, 0.0, 0.0))
    left /= np.linalg.norm(left)
    return np.stack((np.cross(left, up), left, up), axis=1), np.asarray(pose[4:], dtype=np.float64)


def _up(pose: Any) -> Float64[np.ndarray, "3"]:
    """Return the axis that a sensor turns about, seen from the car."""
    return Rotation.from_quat(pose[:4]).as_matrix()[:, 2]


def _columns(path: Path, wanted: tuple[str, ...], data: bytes, may_have: tuple[str, ...] = ()) -> dict[str, np.ndarray]:
    """Unpack some columns of a feather file, and others where it has them, or raise ScanError."""
    try:
        import pyarrow as pa  # noqa: PLC0415  an optional part
        from pyarrow import ipc  # noqa: PLC0415
    except ImportError:
        raise ScanError(f"{path}, which takes pyarrow to read", "it installed", _install()) from None
    try:
        if data[:8] != b"ARROW1\0\0":
            raise ValueError("no Arrow file")
        body = pa.py_buffer(data)[8:]  # behind the file's mark lies an ordinary stream
        schema = ipc.open_stream(body).schema
        if missing := [name for name in wanted if schema.get_all_field_indices(name) == []]:
            raise ValueError(f"no column {', '.join(missing)}")
        wanted += tuple(name for name in may_have if schema.get_all_field_indices(name))
        for name in wanted:
            kind = schema.field(name).type
            if not (pa.types.is_string(kind) if name == "sensor_name" else _is_number(pa, kind)):
                raise ValueError(f"{kind} in the column {name}")
        messages = ipc.MessageReader.open_stream(body)
        if sum(_unpacked_bytes(message) for message in messages) > _MEMORY_BYTES_AT_MOST:
            raise ValueError("far more points than a scan has")
        options = ipc.IpcReadOptions(included_fields=[schema.get_field_index(name) for name in wanted])
        table = ipc.open_stream(body, options=options).read_all()
        table.validate(full=True)
        if any(table[name].null_count for name in wanted):
            raise ValueError("empty cells")
        return {name: table[name].to_numpy() for name in wanted}
    except Exception as error:  # the library meets a damaged file with whatever it stumbles over
        columns = f"an Arrow feather file with the columns {', '.join(wanted)}"
        raise ScanError(f"{path}, which cannot be used ({first_words(error)})", columns, _CURE) from None


def _is_number(pa: Any, kind: Any) -> bool:
    return pa.types.is_integer(kind) or pa.types.is_floating(kind)


def _unpacked_bytes(message: Any) -> int:
    """Return how much memory a message of an Arrow stream says its buffers unpack to.

    Source:
        Apache Arrow, columnar format, Message.fbs: Message.header -> RecordBatch.buffers; each compressed buffer begins
        with its unpacked length, an int64, -1 for one that is not compressed.
    """
    header, body = bytes(message.metadata), message.body
    # No sweep has these: dictionaries are unpacked of whatever column, and version 4 says elsewhere that it is packed.
    if message.type == "dictionary" or b"ARROW:experimental_compression" in header:
        raise ValueError("a column with a dictionary, or packed as in 2020: write it anew by pyarrow's feather")
    if message.type != "record batch":
        return 0

    def number(kind: str, position: int) -> int:
        return struct.unpack_from(kind, header, position)[0]

    def field(table: int, which: int) -> int:
        """Return the position of a field of a flatbuffers table, 0 if it is left out."""
        offsets = table - number("<i", table)
        within = 4 + 2 * which < number("<H", offsets)
        offset = number("<H", offsets + 4 + 2 * which) if within else 0
        return table + offset if offset else 0

    def follow(position: int) -> int:
        return position + number("<I", position)

    batch = follow(field(follow(0), 2))
    buffers = follow(field(batch, 2))
    count = number("<I", buffers)
    if not field(batch, 3):  # not compressed: what it takes is what it is
        return len(body)
    buffer_table = np.frombuffer(header, dtype="<i8", count=2 * count, offset=buffers + 4).reshape(-1, 2)
    starts = [bytes(body[int(offset) : int(offset) + 8]) for offset, length in buffer_table if length >= 8]
    return sum(max(size, 0) for (size,) in map(struct.Struct("<q").unpack, starts)) + len(body)
