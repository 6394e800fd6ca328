"""ROS recordings: what the libraries' own writers write is read, point for point; damaged files are refused."""

import os
import sqlite3

import numpy as np
import pytest

from format_examples import refused_within
from lidargrit.core.errors import ScanError
from lidargrit.data.formats import count_scans, read_scan, ros_bag

rosbag1 = pytest.importorskip("rosbags.rosbag1")
typesys = pytest.importorskip("rosbags.typesys")
mcap_writer = pytest.importorskip("mcap.writer")
records = pytest.importorskip("mcap.records")
data_stream = pytest.importorskip("mcap.data_stream")
zstandard = pytest.importorskip("zstandard")
lz4_frame = pytest.importorskip("lz4.frame")

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


def test_a_computed_message_that_is_too_large_is_refused(tmp_path):
    path = tmp_path / "computed.db3"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE topics(id INTEGER, name TEXT, type TEXT)")
        computed = "data TEXT AS (hex(zeroblob(400000000)))"
        database.execute(f"CREATE TABLE messages(topic_id INTEGER, timestamp INTEGER, {computed})")
        database.execute("INSERT INTO topics VALUES(1, '/top', ?)", (TYPE,))
        database.execute("INSERT INTO messages VALUES(1, 1)")
    database.close()
    with pytest.raises(ScanError, match="too big"):
        read_scan(path)


@pytest.mark.parametrize("recording", [".db3"], indirect=True)
def test_a_stored_message_that_is_too_large_is_refused(recording, monkeypatch):
    monkeypatch.setattr(ros_bag, "BYTES_AT_MOST", 1000)
    with pytest.raises(ScanError, match="too big"):
        read_scan(recording)


PACK = {
    "": bytes,
    "zstd": zstandard.compress,
    "zstd of unknown size": lambda data: zstandard.ZstdCompressor(write_content_size=False).compress(data),
    "lz4": lz4_frame.compress,
    "lz4 of unknown size": lambda data: lz4_frame.compress(data, store_size=False),
}


def message_record(data: bytes, channel: int = 1) -> bytes:
    stream = data_stream.RecordBuilder()
    records.Message(channel_id=channel, data=data, log_time=5, publish_time=5, sequence=0).write(stream)
    return stream.end()


def write_mcap(path, content: bytes, packing: str, in_chunk=None, in_index=None, chunk_in_summary: bool = False):
    """Write a recording of one chunk, whose size may be another in its own header and in the index."""
    packed, compression = PACK[packing](content), packing.partition(" ")[0]
    size = len(content) if in_chunk is None else in_chunk
    stream = data_stream.RecordBuilder()
    records.Chunk(compression, packed, 5, 5, 0, size).write(stream)
    chunk = stream.end()
    start = b"\x89MCAP0\r\n"
    stream = data_stream.RecordBuilder()
    records.Schema(data=b"", encoding="ros2msg", id=1, name=TYPE).write(stream)
    for number, topic in ((1, "/top"), (2, "/rear")):
        records.Channel(id=number, topic=topic, message_encoding="cdr", metadata={}, schema_id=1).write(stream)
    size = len(content) if in_index is None else in_index
    records.ChunkIndex(len(chunk), len(start), compression, len(packed), 5, 0, {1: 0}, 5, size).write(stream)
    records.Statistics(0, 2, {1: 3}, 1, 3, 5, 5, 0, 1).write(stream)
    begins = len(start) + len(chunk)
    records.Footer(summary_crc=0, summary_offset_start=0, summary_start=begins).write(stream)
    path.write_bytes(start + chunk + (chunk if chunk_in_summary else b"") + stream.end() + start)


def refused(path, megabytes: int) -> str:
    count_scans(path)  # loads what the reader needs, which is not to be counted
    os.utime(path)  # so that it is read anew
    return refused_within(path, megabytes)


@pytest.mark.parametrize("packing", PACK)
def test_packed_chunks_are_read(packing, tmp_path):
    store = typesys.get_typestore(typesys.Stores.ROS2_FOXY)
    raw = [bytes(store.serialize_cdr(cloud(store, number), TYPE)) for number in range(3)]
    write_mcap(tmp_path / "a.mcap", b"".join(map(message_record, raw)), packing)
    assert count_scans(tmp_path / "a.mcap") == 3
    for number in range(3):  # all at the same time
        assert np.array_equal(read_scan(tmp_path / "a.mcap", number).points_xyz_m[:, 0].numpy(), rows(number)["x"])


@pytest.mark.parametrize("packing", PACK)
@pytest.mark.parametrize("sizes", [{"in_index": 1000}, {"in_chunk": 1000}, {"in_chunk": 1000, "in_index": 1000}])
def test_a_chunk_that_unpacks_to_more_than_the_index_says_is_refused(packing, sizes, tmp_path):
    write_mcap(tmp_path / "a.mcap", message_record(bytes(30_000_000)), packing, **sizes)
    before_it_is_unpacked = packing and "in_index" in sizes
    said = refused(tmp_path / "a.mcap", 10 if before_it_is_unpacked else 200)
    assert "a chunk that" in said or "decompress" in said


def test_a_chunk_in_the_summary_is_refused_before_it_is_unpacked(tmp_path):
    write_mcap(tmp_path / "a.mcap", message_record(bytes(30_000_000)), "zstd", in_index=1000, chunk_in_summary=True)
    assert "a chunk in its summary" in refused(tmp_path / "a.mcap", 10)


def test_a_chunk_of_very_many_messages_makes_no_list_of_them(tmp_path):
    write_mcap(tmp_path / "a.mcap", message_record(b"", 2) * 50_000 + message_record(b"damaged"), "zstd")
    refused(tmp_path / "a.mcap", 5)


def test_a_bag_whose_chunk_unpacks_to_too_much_is_refused(tmp_path, monkeypatch):
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    path = tmp_path / "a.bag"
    bag = rosbag1.Writer(path)
    bag.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
    with bag:
        top = bag.add_connection("/top", TYPE, typestore=store)
        for number in range(2):
            bag.write(top, 10, store.serialize_ros1(cloud(store, number), TYPE))
    for number in range(2):
        assert np.array_equal(read_scan(path, number).points_xyz_m[:, 0].numpy(), rows(number)["x"])
    monkeypatch.setattr(ros_bag, "BYTES_AT_MOST", 1000)
    with pytest.raises(ScanError, match="that unpacks to more than any recorder's"):
        read_scan(path)


def test_the_index_of_a_bag_is_read_once(tmp_path, monkeypatch):
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    path = tmp_path / "a.bag"
    bag = rosbag1.Writer(path)
    bag.chunk_threshold = 1  # one message a chunk
    with bag:
        top, rear = (bag.add_connection(topic, TYPE, typestore=store) for topic in ("/top", "/rear"))
        for number in range(6):
            bag.write(top, 20 - number // 2, store.serialize_ros1(cloud(store, number), TYPE))
        bag.write(rear, 10, store.serialize_ros1(cloud(store, 9), TYPE))
    opened, opening = [], rosbag1.Reader.open
    monkeypatch.setattr(rosbag1.Reader, "open", lambda reader: (opened.append(reader), opening(reader))[1])
    found = [read_scan(path, index).points_xyz_m[:, 0].numpy() for index in range(6)]
    assert len(opened) == 1
    for scan, number in zip(found, (4, 5, 2, 3, 0, 1), strict=True):  # in the order of time, then of the file
        assert np.array_equal(scan, rows(number)["x"])
