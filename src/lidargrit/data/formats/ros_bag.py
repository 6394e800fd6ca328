"""ROS recordings (.bag, .mcap, .db3): messages sensor_msgs/PointCloud2 of one topic → :class:`Scan`."""

import functools
import sqlite3
import warnings
from collections import Counter
from collections.abc import Collection
from contextlib import closing
from dataclasses import replace
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, Protocol, runtime_checkable
from urllib.parse import quote

from lidargrit.core.errors import ScanError, printable
from lidargrit.core.files import remembered, state_of
from lidargrit.data.formats import BadPoints, ScanFormat, damaged, first_bytes, open_file
from lidargrit.data.formats.shared.columns import BYTES_AT_MOST, REFLECTANCE_RULE, scan_of_columns
from lidargrit.data.formats.shared.mcap import (
    CHUNK_BYTES_AT_MOST,
    Contents,
    contents_by_index,
    contents_by_records,
    messages,
    unpacked_lz4,
)
from lidargrit.data.formats.shared.point_cloud2 import columns_of_cloud
from lidargrit.scans.types import Scan

_FORMAT = "a recording of ROS with messages sensor_msgs/PointCloud2"
_INSTALL = "pip install 'lidargrit[ros]'"
_MAGIC = {".bag": b"#ROSBAG V2.0", ".mcap": b"\x89MCAP", ".db3": b"SQLite format 3\x00"}
_TYPES = ("sensor_msgs/msg/PointCloud2", "sensor_msgs/PointCloud2")
_MESSAGES_AT_MOST = 1_000_000  # a day at ten revolutions a second
_SQLITE_STEPS_AT_MOST = 100_000_000  # of its machine, for one question: a second or two
_ZSTD = b"\x28\xb5\x2f\xfd"


class RosBag(ScanFormat):
    """Recordings of ROS 1 (``.bag``) and ROS 2 (``.mcap``, ``.db3``): one scan for each message with a point cloud.

    Of several topics with point clouds the one with the most messages counts, of equally many the first by name, unless
    one is chosen (:meth:`of_topic`). A file
    needs no ``metadata.yaml`` beside it; each file of a split recording is read by itself.

    Source:
        sensor_msgs/PointCloud2 and PointField of ROS; unpacked by the libraries rosbags and mcap.
    """

    title = "ROS recording (.bag, .mcap, .db3)"
    suffixes = (".bag", ".mcap", ".db3")
    reflectance = REFLECTANCE_RULE
    several = True
    topics = True
    extra = "ros"

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether a file begins as a recording."""
        return first_bytes(path, 16).startswith(tuple(_MAGIC.values()))

    @staticmethod
    def count(path: Path, topic: str = "") -> int:
        """Count the point clouds of the topic."""
        return len(_open(path, topic).times)

    @staticmethod
    def read(path: Path, index: int = 0, bad_points: BadPoints = "refuse", topic: str = "") -> Scan:
        """Read one point cloud."""
        recording = _open(path, topic)
        if not 0 <= index < len(recording.times):
            what = f"scan number {index} of {path}"
            raise ScanError(what, f"one of its {len(recording.times)}, counted from 0", "take another")
        try:
            cloud = recording.message(index)
            columns, notes = columns_of_cloud(cloud)
        except ScanError:
            raise
        except Exception as error:  # the libraries meet damaged bytes with whatever they stumble over
            raise damaged(path, _FORMAT, error) from None
        scan = scan_of_columns(columns, path.with_name(f"{path.name}#{index}"), bad_points)
        stamp = cloud.header.stamp
        time_s = float(stamp.sec) + float(stamp.nanosec) / 1e9
        return replace(scan, notes=(*recording.notes, *notes, *scan.notes), time_s=time_s or None)


@runtime_checkable
class _Recording(Protocol):
    """The messages of one topic, in the order of time."""

    times: list[int]
    """Time of each message, or another number that orders and finds them."""
    notes: tuple[str, ...]
    """Sentences on what is not read."""

    def message(self, index: int) -> Any: ...


def _open(path: Path, topic: str) -> _Recording:
    with open_file(path, _FORMAT) as file:
        start = file.read(16)
    kind = next((kind for kind, magic in _MAGIC.items() if start.startswith(magic)), None)
    if kind is None:
        raise ScanError(f"{path}, which is no recording", _FORMAT, "check what wrote it")
    try:
        with warnings.catch_warnings(action="ignore"):  # of what a library will drop
            recording = _opened(kind, path, topic)
    except ImportError as error:
        raise ScanError(f"{path}, which takes {error.name or 'rosbags'} to read", "it installed", _INSTALL) from None
    except ScanError:
        raise
    except Exception as error:
        raise damaged(path, _FORMAT, error) from None
    if not 1 <= len(recording.times) <= _MESSAGES_AT_MOST:
        raise ScanError(f"{len(recording.times)} point clouds in {path}", _FORMAT, "record the lidar's topic")
    return recording


@remembered(lambda kind, path, topic: [path], at_most=4)
def _opened(kind: str, path: Path, topic: str) -> _Recording:
    return {".bag": _Ros1, ".mcap": _Mcap, ".db3": _Sqlite}[kind](path, topic)


def _chosen(topics: Counter[str], path: Path, types: Collection[str], wanted: str) -> tuple[str, tuple[str, ...]]:
    """Return the topic that is wanted or has the most point clouds, and a note on what was left alone.

    Args:
        topics: number of point clouds of each topic.
        types: types of all its messages.
        wanted: topic that the user chose; "" for none.
    """
    if not topics:
        what = f"{path}, which has no topic of PointCloud2 ({_named(types) or 'no message at all'})"
        packets = any("packet" in each.lower() or "VelodyneScan" in each for each in types)
        cure = "play it through the lidar's driver and record the topic of clouds" if packets else "record that topic"
        raise ScanError(what, _FORMAT, cure)
    if wanted and wanted not in topics:
        there = ", ".join(printable(topic)[:80] for topic in sorted(topics)[:5])
        raise ScanError(f"the topic {wanted!r} of {path}", f"one with point clouds: {there}", "name one of these")
    taken, *others = sorted(topics, key=lambda topic: (-topics[topic], topic))
    if wanted or not others:
        taken = wanted or taken
        return taken, ()
    there = ", ".join(f"{printable(topic)[:80]} ({topics[topic]:,})" for topic in others[:3])
    more = f" and {len(others) - 3} more" if len(others) > 3 else ""
    cure = f"choose by {printable(path.name)}:{printable(others[0])[:80]}"
    clouds = f"{topics[taken]:,} {'cloud' if topics[taken] == 1 else 'clouds'}"
    return taken, (f"topic {printable(taken)[:80]} taken ({clouds}), not {there}{more}; {cure}",)


def _named(types: Collection[str]) -> str:
    """Return the first few types of messages, for a message."""
    return ", ".join(printable(each)[:60] for each in sorted(types)[:4]) + (", ..." if len(types) > 4 else "")


class _Ros1:
    def __init__(self, path: Path, topic: str) -> None:
        from rosbags.rosbag1 import Reader  # noqa: PLC0415  an optional part

        self._path, reader = path, Reader(path)
        try:
            reader.open()
        finally:  # the library leaves the file open where it meets a damaged one
            if reader.bio is not None:
                reader.bio.close()
        for chunk in reader.chunks.values():
            if chunk.datasize > CHUNK_BYTES_AT_MOST or chunk.decompressor.__module__ == "bz2":
                what = f"{path}, whose chunks are packed by bzip2 or larger than 64 MB"
                raise ScanError(what, "chunks of lz4, or unpacked ones", "unpack it with: rosbag decompress")
        clouds = [each for each in reader.connections if each.msgtype in _TYPES]
        counts: Counter[str] = Counter()
        for each in clouds:
            counts[each.topic] += each.msgcount
        topic, self.notes = _chosen(counts, path, {each.msgtype for each in reader.connections}, topic)
        if counts[topic] > _MESSAGES_AT_MOST:
            raise ValueError("more messages than a recording can have")
        entries = (entry for each in clouds if each.topic == topic for entry in reader.indexes[each.id])
        # The whole index is read once, here: a long recording has a hundred thousand entries.
        self._entries = sorted(entries, key=lambda entry: entry.time)
        self._chunks = reader.chunks
        self.times = [entry.time for entry in self._entries]

    def message(self, index: int) -> Any:
        from rosbags.rosbag1.reader import Header, RecordType  # noqa: PLC0415  an optional part

        entry = self._entries[index]
        chunk = self._chunks[entry.chunk_pos]
        with self._path.open("rb") as file:
            file.seek(chunk.datapos)
            packed = file.read(chunk.datasize)
        # The library's own function would unpack whatever is there.
        is_packed = chunk.decompressor.__module__.startswith("lz4")
        records = BytesIO(unpacked_lz4(packed, BYTES_AT_MOST) if is_packed else packed)
        records.seek(entry.offset)
        kind, data = RecordType.CONNECTION, b""
        while kind == RecordType.CONNECTION:  # which may stand before the first message of each
            kind = Header.read(records).get_uint8("op")
            data = records.read(int.from_bytes(records.read(4), "little"))
        if kind != RecordType.MSGDATA:
            raise ValueError("an index that leads to no message")
        return _decoded(data, "ros1")


class _Mcap:
    def __init__(self, path: Path, topic: str) -> None:
        self._path = path
        with path.open("rb") as file:
            there = contents_by_index(file)
            if there is None or not self._take(file, there, topic):
                there = contents_by_records(file, _TYPES)
                self._take(file, there, topic)
        if there.cut_at:
            size, name = path.stat().st_size, path.name
            lost = f"cut off or damaged from byte {there.cut_at:,} of {size:,} on; what lies behind is not read"
            self.notes = (*self.notes, f"{lost}: mcap recover {name} -o whole_{name} may find more")

    def _take(self, file: BinaryIO, there: Contents, wanted: str) -> bool:
        """Take over the topic; return whether as many messages were found as there should be."""
        clouds = [each for each in there.channels.values() if there.schemas.get(each.schema_id) in _TYPES]
        topics: Counter[str] = Counter()
        for each in clouds:
            topics[each.topic] += there.counts[each.id]
        if there.cut_at and not topics.total():
            what = f"{self._path}, cut off or damaged at byte {there.cut_at:,}, before its first point cloud"
            raise ScanError(what, _FORMAT, f"try: mcap recover {self._path.name} -o whole_{self._path.name}")
        topic, self.notes = _chosen(topics, self._path, {*there.schemas.values()}, wanted)
        if topics[topic] > _MESSAGES_AT_MOST:
            raise ValueError("more messages than a recording can have")
        self._encoding = next(each.message_encoding for each in clouds if each.topic == topic)
        self._channels = {each.id for each in clouds if each.topic == topic}
        self._places = there.places
        found = islice(messages(file, self._places, self._channels), _MESSAGES_AT_MOST + 1)
        self.times = sorted(message.log_time for message in found)
        return len(self.times) == topics[topic]

    def message(self, index: int) -> Any:
        time, same = self.times[index], self.times[:index].count(self.times[index])
        places = [each for each in self._places if each.first <= time <= each.last]
        with self._path.open("rb") as file:
            found = (each.data for each in messages(file, places, self._channels) if each.log_time == time)
            raw = next(islice(found, same, None))
        return _decoded(raw, self._encoding)


class _Sqlite:
    def __init__(self, path: Path, topic: str) -> None:
        self._path = path
        log = path.with_name(f"{path.name}-wal")
        if (state := state_of(log)) and state[0]:
            what = f"{path}, whose last messages lie in {log.name}: the recorder did not close it"
            raise ScanError(what, "a closed recording", f"sqlite3 {path.name} 'PRAGMA wal_checkpoint(TRUNCATE)'")
        topics: Counter[str] = Counter()
        with closing(self._connected()) as database:
            kinds = dict(database.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'"))
            for table in ("topics", "messages"):  # and no view or virtual table, which could be anything
                if not str(kinds.get(table, "")).upper().startswith("CREATE TABLE"):
                    raise ValueError(f"no table {table}")
            numbers, types = dict[str, int](), set[str]()
            for number, name, kind in database.execute("SELECT id, name, type FROM topics LIMIT 10000"):
                types.add(str(kind))
                if kind in _TYPES:
                    numbers[str(name)] = int(number)
                    (count,) = database.execute(
                        "SELECT COUNT(*) FROM messages WHERE topic_id = ?", (number,)
                    ).fetchone()
                    topics[str(name)] = count
            topic, self.notes = _chosen(topics, path, types, topic)
            number = numbers[topic]
            query = "SELECT rowid FROM messages WHERE topic_id = ? ORDER BY timestamp, rowid LIMIT ?"
            self.times = [row for (row,) in database.execute(query, (number, _MESSAGES_AT_MOST + 1))]

    def message(self, index: int) -> Any:
        with closing(self._connected()) as database:
            (raw,) = database.execute("SELECT data FROM messages WHERE rowid = ?", (self.times[index],)).fetchone()
        return _decoded(raw, "cdr")

    def _connected(self) -> sqlite3.Connection:
        """Open the file to read only, without files beside it, and with an end to every question."""
        database = sqlite3.connect(f"file:{quote(str(self._path.resolve()))}?mode=ro&immutable=1", uri=True)
        database.execute("PRAGMA trusted_schema = OFF")
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, BYTES_AT_MOST)  # of a column that is computed, too
        database.set_progress_handler(lambda: 1, _SQLITE_STEPS_AT_MOST)
        return database


def _decoded(raw: bytes, encoding: str) -> Any:
    if encoding == "ros1":
        return _types("ROS1_NOETIC").deserialize_ros1(raw, _TYPES[0])
    if encoding != "cdr":
        raise ValueError(f"messages in {encoding[:20]}, not in cdr")
    if raw.startswith(_ZSTD):  # rosbag2 can compress message by message; none in cdr begins so
        raw = _unpacked_zstd(raw)
    return _types("ROS2_FOXY").deserialize_cdr(raw, _TYPES[0])


def _unpacked_zstd(packed: bytes) -> bytes:
    from zstandard import ZstdDecompressor  # noqa: PLC0415  an optional part

    with ZstdDecompressor(max_window_size=BYTES_AT_MOST).stream_reader(packed) as stream:
        unpacked = stream.read(BYTES_AT_MOST + 1)
    if len(unpacked) > BYTES_AT_MOST:
        raise ValueError("a message that unpacks to more than any point cloud")
    return unpacked


@functools.cache  # which takes longer to make than a scan to read
def _types(release: str) -> Any:
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415  an optional part

    return get_typestore(Stores[release])
