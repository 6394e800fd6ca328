"""MCAP with messages of ROS 2: clouds as sensor_msgs/PointCloud2 on /lidar/points, poses as tf2_msgs/TFMessage on /tf.

Foxglove, rerun, RViz and our own reader open it.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from lidargrit.data.formats.shared.columns import columns_of
from lidargrit.scans.types import Scan

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_CLOUD, _POSES = "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage"
_DATATYPES = {"u1": 2, "u2": 4, "u4": 6, "f4": 7, "f8": 8}  # of PointField
_WORLD, _SENSOR = "map", "lidar"  # names of the frames


def write(path: Path, name: str, scans: Iterable[tuple[float, Scan]]) -> None:
    """Write scans, each with its time in seconds, and where its pose is known a transform from the first frame."""
    from mcap.writer import Writer  # noqa: PLC0415  an optional part
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    store = get_typestore(Stores.ROS2_FOXY)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "lidargrit")
        channels = dict[str, int]()
        for topic, kind in (("/lidar/points", _CLOUD), ("/tf", _POSES)):
            definition, _ = store.generate_msgdef(kind, ros_version=2)
            schema = writer.register_schema(kind, "ros2msg", definition.encode())
            channels[kind] = writer.register_channel(topic, "cdr", schema)
        for time_s, scan in scans:
            time_ns = round(time_s * 1e9)
            for kind, message in _messages(store, time_ns, scan).items():
                writer.add_message(channels[kind], time_ns, bytes(store.serialize_cdr(message, kind)), time_ns)
        writer.finish()


def _messages(store: "Typestore", time_ns: int, scan: Scan) -> dict[str, object]:
    """Return the messages of one scan by their types; the pose first, since a viewer places the cloud by it."""
    types, messages = store.types, dict[str, object]()
    stamp = types["builtin_interfaces/msg/Time"](*divmod(time_ns, 10**9))
    header = types["std_msgs/msg/Header"]
    if scan.pose is not None:
        pose = scan.pose.numpy()
        place = types["geometry_msgs/msg/Vector3"](*map(float, pose[:3, 3]))
        turn = types["geometry_msgs/msg/Quaternion"](*map(float, Rotation.from_matrix(pose[:3, :3]).as_quat()))
        transform = types["geometry_msgs/msg/Transform"](place, turn)
        stamped = types["geometry_msgs/msg/TransformStamped"](header(stamp, _WORLD), _SENSOR, transform)
        messages[_POSES] = types[_POSES]([stamped])
    columns = columns_of(scan)
    rows = np.rec.fromarrays([*columns.values()], [(name, values.dtype) for name, values in columns.items()])
    offsets = np.cumsum([0, *(values.dtype.itemsize for values in columns.values())]).tolist()
    fields = [
        types["sensor_msgs/msg/PointField"](name, offset, _DATATYPES[values.dtype.str[1:]], 1)
        for (name, values), offset in zip(columns.items(), offsets, strict=False)
    ]
    size, data = rows.dtype.itemsize, np.frombuffer(rows.tobytes(), np.uint8)
    messages[_CLOUD] = types[_CLOUD](header(stamp, _SENSOR), 1, len(rows), fields, False, size, len(data), data, True)
    return messages
