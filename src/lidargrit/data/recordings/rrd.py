"""Recordings of rerun (.rrd): clouds under world/lidar, moved by their poses, on the time lines scan and time."""

from collections.abc import Iterable
from importlib import import_module
from pathlib import Path

import numpy as np

from lidargrit.scans.types import Scan

_CLOUD = "world/lidar"


def write(path: Path, name: str, scans: Iterable[tuple[float, Scan]]) -> None:
    """Write scans, each with its time in seconds, shaded by their reflectance, with labels as class ids."""
    rr = import_module("rerun")  # an extra

    stream = rr.RecordingStream("lidargrit", recording_id=name, send_properties=False)
    stream.save(path)
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for number, (time_s, scan) in enumerate(scans):
        stream.set_time("scan", sequence=number)
        stream.set_time("time", timestamp=time_s)
        if scan.pose is not None:
            pose = scan.pose.numpy()
            stream.log(_CLOUD, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        shades = None if scan.reflectance is None else np.rint(scan.reflectance.numpy() * 255).astype(np.uint8)
        colours = None if shades is None else np.repeat(shades[:, None], 3, axis=1)
        classes = None if scan.label is None else (scan.label.numpy() & 0xFFFF).astype(np.uint16)
        stream.log(_CLOUD, rr.Points3D(scan.points_xyz_m.numpy(), colors=colours, class_ids=classes))
    stream.flush()
    stream.disconnect()
