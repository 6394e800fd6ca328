"""ROS recordings: what the libraries' own writers write is read, point for point; damaged files are refused."""

import sqlite3

import numpy as np
import pytest

from lidargrit.errors import ScanError
from lidargrit.formats import count_scans, read_scan

rosbag1 = pytest.importorskip("rosbags.rosbag1")
typesys = pytest.importorskip("rosbags.typesys")
mcap_writer = pytest.importorskip("mcap.writer")

TYPE, POINTS = "sensor_msgs/msg/PointCloud2", 40
ROWS = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f8")])


def rows(number: int) -> np.ndarray:
    rng = np.random.default_rng(number)
    table = np.zeros(POINTS, ROWS)
    for axis in "xyz":
        table[axis] = rng.normal(0, 9, POINTS)
    table["intensity"] = rng.integers(0, 256, POINTS)
    table["ring"] = np.argsort(np.argsort(np.arctan2(table["z"], np.hypot(table["x"], table["y"])))) // 3
    return table


def cloud(store, number: int, topic_width: int = POINTS):
    types = store.types
    table = rows(number)[:topic_width]
    kinds = {"f4": 7, "u2": 4, "f8": 8}
    fields = [
        types["sensor_msgs/msg/PointField"](name, ROWS.fields[name][1], kinds[ROWS[name].str[1:]], 1)
        for name in ROWS.names
    ]
    stamp = types["builtin_interfaces/msg/Time"](number, 0)
    extra = (number,) if "seq" in types["std_msgs/msg/Header"].__dataclass_fields__ else ()
    header = types["std_msgs/msg/Header"](*extra, stamp, "lidar")
    data = np.frombuffer(table.tobytes(), np.uint8)
    size = ROWS.itemsize
    return types[TYPE](header, 1, len(table), fields, False, size, size * len(table), data, True)


@pytest.fixture(scope="module", params=[".bag", ".mcap", ".db3"])
def recording(request, tmp_path_factory):
    """Write three clouds of one topic and one of another, in the order of time."""
    path = tmp_path_factory.mktemp("ros") / f"drive{request.param}"
    if request.param == ".bag":
        store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
        with rosbag1.Writer(path) as bag:
            ids = {topic: bag.add_connection(topic, TYPE, typestore=store) for topic in ("/rear", "/top")}
            for number, topic in enumerate(("/top", "/rear", "/top", "/top")):
                bag.write(ids[topic], 10 + number, store.serialize_ros1(cloud(store, number), TYPE))
        return path
    store = typesys.get_typestore(typesys.Stores.ROS2_FOXY)
    raw = [bytes(store.serialize_cdr(cloud(store, number), TYPE)) for number in range(4)]
    topics = ("/top", "/rear", "/top", "/top")
    if request.param == ".mcap":
        with path.open("wb") as file:
            writer = mcap_writer.Writer(file)
            writer.start()
            schema = writer.register_schema(TYPE, "ros2msg", b"")
            ids = {topic: writer.register_channel(topic, "cdr", schema) for topic in ("/rear", "/top")}
            for number, topic in enumerate(topics):
                writer.add_message(ids[topic], 10 + number, raw[number], 10 + number)
            writer.finish()
        return path
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        database.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
        )
        database.executemany("INSERT INTO topics VALUES (?, ?, ?, 'cdr')", [(1, "/rear", TYPE), (2, "/top", TYPE)])
        for number, topic in enumerate(topics):
            sent = (1 + (topic == "/top"), 10 + number, raw[number])
            database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", sent)
    database.close()
    return path


def test_every_cloud_of_the_busiest_topic_is_read(recording):
    assert count_scans(recording) == 3
    for index, number in enumerate((0, 2, 3)):
        scan, table = read_scan(recording, index), rows(number)
        assert np.array_equal(scan.points_xyz_m.numpy(), np.stack([table[axis] for axis in "xyz"], 1))
        assert np.array_equal(scan.reflectance.numpy(), table["intensity"] / np.float32(255))
        assert int(scan.ring[scan.points_xyz_m[:, 2].argmax()]) < int(scan.ring[scan.points_xyz_m[:, 2].argmin()])
    with pytest.raises(ScanError, match="one of its 3"):
        read_scan(recording, 3)


def test_damaged_recordings_are_refused_in_one_line(recording, tmp_path):
    data, rng = recording.read_bytes(), np.random.default_rng(0)
    messages = []
    for number in range(60):
        damaged = bytearray(data)
        if number % 3:
            for offset in rng.integers(0, len(data), 1 + number % 7):
                damaged[offset] = rng.integers(0, 256)
        else:
            del damaged[int(rng.integers(0, len(data))) :]
        path = tmp_path / f"{number}{recording.suffix}"
        path.write_bytes(damaged)
        try:
            read_scan(path, 0, "drop")
        except ScanError as error:
            messages.append(str(error).replace(str(path), ""))
    assert len(messages) >= 10
    assert all("\n" not in line and len(line) < 400 for line in messages)


def test_a_view_in_place_of_the_messages_is_refused(tmp_path):
    path = tmp_path / "endless.db3"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE topics(id INTEGER, name TEXT, type TEXT)")
        endless = (
            "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i FROM n) SELECT i AS topic_id, i AS timestamp FROM n"
        )
        database.execute(f"CREATE VIEW messages AS {endless}")
    database.close()
    with pytest.raises(ScanError, match="no table messages"):
        read_scan(path)
