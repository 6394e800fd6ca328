"""What tests of file formats share: a small scan for each format, and files of it in all the ways they are written."""

import math
import tracemalloc
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from pypcd4.pypcd4 import Encoding, PointCloud

from lidargrit.core import discovery
from lidargrit.core.errors import ScanError
from lidargrit.data.formats import ScanFormat, load, read_scan
from lidargrit.scans.projection import unproject
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage, Scan

NAMES = discovery.names("formats")


def can_write(cls: type[ScanFormat]) -> bool:
    return cls.can_write()


def example(cls: type[ScanFormat], columns: int = 64) -> Scan:
    """Return a scan of the format's sensor, in firing order, with everything that a scan can have.

    It is of a round place between wavy walls, made here so that these tests need no simulator.
    """
    sensor = load_sensor(cls.sensor or "hdl64e_kitti_odometry").with_columns(columns)
    down = -sensor.ray_directions()[:, :, 2]
    azimuth_rad = sensor.azimuth_rad.expand(sensor.height, columns)
    range_m = torch.where(down > 0, 1.73 / down.clamp(min=1e-3), 1000.0).minimum(20 + 8 * (3 * azimuth_rad).sin())
    returned = torch.rand(range_m.shape, generator=torch.Generator().manual_seed(0)) < 0.9
    reflectance = (0.5 + 0.49 * (5 * azimuth_rad).cos()) * returned
    scan = unproject(RangeImage(range_m * returned, returned, sensor, {"reflectance": reflectance}))
    assert scan.ring is not None
    assert scan.reflectance is not None
    circle_rad = torch.atan2(*scan.points_xyz_m[:, :2].double().T.flip(0)) % (2 * math.pi)
    order = (scan.ring * 10 + circle_rad).argsort()
    ring = scan.ring[order]
    return Scan(scan.points_xyz_m[order], scan.reflectance[order], ring, ring * 65_537 + 40)


def written(cls: type[ScanFormat], folder: Path, suffix: str = "", columns: int = 64) -> Path:
    """Write the example to a new file; the contents are the same each time."""
    path = folder / f"example{suffix or cls.suffixes[0]}"
    cls.write(path, example(cls, columns))
    return path


def refused_within(path: Path, megabytes: int) -> str:
    """Read a file that must be refused before it takes that much memory, and return the message."""
    tracemalloc.start()
    try:
        with pytest.raises(ScanError) as refusal:
            read_scan(path)
        most_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert most_bytes < megabytes * 1_000_000
    return str(refusal.value)


def small_files(folder: Path) -> list[tuple[str, str, bytes]]:
    """Return format, name and bytes of small valid files, of every way of writing that readers know."""
    files = []
    for cls in map(load, NAMES):
        for suffix in cls.suffixes if can_write(cls) else ():
            path = written(cls, folder, suffix, columns=64 if suffix == ".png" else 4)  # images are of full revolutions
            files.append((cls.public_name(), path.name, path.read_bytes()))
    scan = example(load("numpy_array"), columns=4)
    xyz, reflectance, ring = scan.points_xyz_m.numpy(), scan.reflectance.numpy(), scan.ring.numpy()
    files += [("pcd", f"{name}.pcd", data) for name, data in pcd_files(xyz, reflectance, ring).items()]
    files += [("ply", f"{name}.ply", data) for name, data in ply_files(xyz, reflectance, ring).items()]
    return files + [("numpy_array", name, data) for name, data in numpy_files(xyz, reflectance, ring).items()]


def pcd_files(xyz: np.ndarray, reflectance: np.ndarray, ring: np.ndarray) -> dict[str, bytes]:
    """Return files that another library wrote: in its three encodings, intensity 0..255 or of 16 bits."""
    columns = {
        "x": xyz[:, 0].astype(np.float64),
        "y": xyz[:, 1],
        "z": xyz[:, 2],
        "intensity": (reflectance * 255).round().astype(np.uint8),
        "stamp": np.arange(len(xyz), dtype=np.int32),
        "channel": (63 - ring).astype(np.uint16),
    }
    cloud = PointCloud.from_points(list(columns.values()), list(columns), [one.dtype for one in columns.values()])
    files = {}
    for encoding in (Encoding.ASCII, Encoding.BINARY, Encoding.BINARY_COMPRESSED):
        buffer = BytesIO()
        cloud.save(buffer, encoding)
        files[f"pcd_{encoding.value}"] = buffer.getvalue()
    return files


def ply_files(xyz: np.ndarray, reflectance: np.ndarray, ring: np.ndarray) -> dict[str, bytes]:
    """Return files written by hand in the three encodings, with elements before and after the vertices."""
    head = (
        "ply\nformat {} 1.0\ncomment made by hand\nelement camera 1\nproperty float view\n"
        f"element vertex {len(xyz)}\nproperty double x\nproperty double y\nproperty double z\n"
        "property uchar scalar_Intensity\nproperty ushort ring\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    row = np.dtype([("x", "f8"), ("y", "f8"), ("z", "f8"), ("i", "u1"), ("ring", "u2")])
    rows = np.zeros(len(xyz), dtype=row)
    rows["x"], rows["y"], rows["z"] = xyz.T
    rows["i"], rows["ring"] = (reflectance * 255).round(), ring
    lines = "".join(f"{x!r} {y!r} {z!r} {i} {r}\n" for x, y, z, i, r in rows.tolist())
    files = {"ply_ascii": f"{head.format('ascii')}0.5\n{lines}3 0 1 2\n".encode()}
    for name, order in (("binary_little_endian", "<"), ("binary_big_endian", ">")):
        before, after = np.array([0.5], order + "f4").tobytes(), b"\3" + np.arange(3, dtype=order + "i4").tobytes()
        body = before + rows.astype(row.newbyteorder(order)).tobytes() + after
        files[f"ply_{name}"] = head.format(name).encode() + body
    return files


def numpy_files(xyz: np.ndarray, reflectance: np.ndarray, ring: np.ndarray) -> dict[str, bytes]:
    """Return arrays of other types and orders, and a packed archive."""
    files = {}
    for name, rows in (
        ("npy_xyz_double_by_column.npy", np.asfortranarray(xyz, dtype=np.float64)),
        ("npy_five_big_endian.npy", np.column_stack((xyz, 255 * reflectance, ring)).astype(">f4")),
    ):
        buffer = BytesIO()
        np.save(buffer, rows)
        files[name] = buffer.getvalue()
    buffer = BytesIO()
    np.savez_compressed(buffer, xyz=xyz, intensity=(reflectance * 65_535).astype(np.uint16), ring=ring, other=xyz[:3])
    return {**files, "npz_packed.npz": buffer.getvalue()}
