"""ROS recordings (.bag, .mcap, .db3): messages sensor_msgs/PointCloud2 of one topic → :class:`Scan`."""

from __future__ import annotations

import functools
import os
import sqlite3
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, Protocol, runtime_checkable
from urllib.parse import quote

import numpy as np

from lidargrit.core.errors import ScanError
from lidargrit.data.formats import POINTS_AT_MOST, BadPoints, ScanFormat, damaged, first_bytes, open_file
from lidargrit.data.formats.shared.columns import BYTES_AT_MOST, REFLECTANCE_RULE, scan_of_columns
from lidargrit.scans.types import Scan

_FORMAT = "a recording of ROS with messages sensor_msgs/PointCloud2"
_INSTALL = "pip install 'lidargrit[ros]'"
_MAGIC = {".bag": b"#ROSBAG V2.0", ".mcap": b"\x89MCAP", ".db3": b"SQLite format 3\x00"}
_TYPES = ("sensor_msgs/msg/PointCloud2", "sensor_msgs/PointCloud2")
_MESSAGES_AT_MOST = 1_000_000  # a day at ten revolutions a second
_CHUNK_BYTES_AT_MOST = 64_000_000  # as packed in the file: recorders write below 10 MB
_SQLITE_STEPS_AT_MOST = 100_000_000  # of its machine, for one question: a second or two
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # PointField's datatype


class RosBag(ScanFormat):
    """Recordings of ROS 1 (``.bag``) and ROS 2 (``.mcap``, ``.db3``): one scan for each message with a point cloud.

    Of several topics with point clouds the one with the most messages counts, of equally many the first by name. A file
    needs no ``metadata.yaml`` beside it; each file of a split recording is read by itself.

    Source:
        sensor_msgs/PointCloud2 and PointField of ROS; unpacked by the libraries rosbags and mcap.
    """

    title = "ROS recording (.bag, .mcap, .db3)"
    suffixes = (".bag", ".mcap", ".db3")
    reflectance = REFLECTANCE_RULE
    several = True
    extra = "ros"

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether a file begins as a recording."""
        return first_bytes(path, 16).startswith(tuple(_MAGIC.values()))

    @staticmethod
    def count(path: Path) -> int:
        """Count the point clouds of the topic."""
        return len(_open(path).times)

    @staticmethod
    def read(path: Path, index: int = 0, bad_points: BadPoints = "refuse") -> Scan:
        """Read one point cloud."""
        recording = _open(path)
        if not 0 <= index < len(recording.times):
            what = f"scan number {index} of {path}"
            raise ScanError(what, f"one of its {len(recording.times)}, counted from 0", "take another")
        try:
            columns = _columns(recording.message(index))
        except ScanError:
            raise
        except Exception as error:  # the libraries meet damaged bytes with whatever they stumble over
            raise damaged(path, _FORMAT, error) from None
        return scan_of_columns(columns, path.with_name(f"{path.name}#{index}"), bad_points)


@runtime_checkable
class _Recording(Protocol):
    """The messages of one topic, in the order of time."""

    times: list[int]
    """Time of each message, or another number that orders and finds them."""

    def message(self, index: int) -> Any:
        """Return one PointCloud2, by its number."""
        ...


def _open(path: Path) -> _Recording:
    with open_file(path, _FORMAT) as file:
        start = file.read(16)
    kind = next((kind for kind, magic in _MAGIC.items() if start.startswith(magic)), None)
    if kind is None:
        raise ScanError(f"{path}, which is no recording", _FORMAT, "check what wrote it")
    try:
        status = path.stat()
        with warnings.catch_warnings(action="ignore"):  # of what a library will drop
            recording = _opened(kind, path, (status.st_size, status.st_mtime_ns))
    except ImportError as error:
        raise ScanError(f"{path}, which takes {error.name or 'rosbags'} to read", "it installed", _INSTALL) from None
    except ScanError:
        raise
    except Exception as error:
        raise damaged(path, _FORMAT, error) from None
    if not 1 <= len(recording.times) <= _MESSAGES_AT_MOST:
        raise ScanError(f"{len(recording.times)} point clouds in {path}", _FORMAT, "record the lidar's topic")
    return recording


@functools.lru_cache(maxsize=4)
def _opened(kind: str, path: Path, _version: tuple[int, int]) -> _Recording:
    return {".bag": _Ros1, ".mcap": _Mcap, ".db3": _Sqlite}[kind](path)


def _busiest(topics: Counter[str], path: Path) -> str:
    """Return the topic with the most point clouds."""
    if not topics:
        raise ScanError(
            f"{path}, which has no topic of PointCloud2", _FORMAT, "record the lidar's topic, or leave it out"
        )
    return min(topics, key=lambda topic: (-topics[topic], topic))


class _Ros1:
    def __init__(self, path: Path) -> None:
        from rosbags.rosbag1 import Reader  # noqa: PLC0415  an optional part

        self._path, reader = path, Reader(path)
        try:
            reader.open()
        finally:  # the library leaves the file open where it meets a damaged one
            if reader.bio is not None:
                reader.bio.close()
        for chunk in reader.chunks.values():
            if chunk.datasize > _CHUNK_BYTES_AT_MOST or chunk.decompressor.__module__ == "bz2":
                what = f"{path}, whose chunks are packed by bzip2 or larger than 64 MB"
                raise ScanError(what, "chunks of lz4, or unpacked ones", "unpack it with: rosbag decompress")
        clouds = [each for each in reader.connections if each.msgtype in _TYPES]
        counts: Counter[str] = Counter()
        for each in clouds:
            counts[each.topic] += each.msgcount
        topic = _busiest(counts, path)
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
        records = BytesIO(_unpacked_lz4(packed, BYTES_AT_MOST) if is_packed else packed)
        records.seek(entry.offset)
        kind, data = RecordType.CONNECTION, b""
        while kind == RecordType.CONNECTION:  # which may stand before the first message of each
            kind = Header.read(records).get_uint8("op")
            data = records.read(int.from_bytes(records.read(4), "little"))
        if kind != RecordType.MSGDATA:
            raise ValueError("an index that leads to no message")
        return _decoded(data, "ros1")


def _unpacked_lz4(packed: bytes, at_most: int) -> bytes:
    from lz4.frame import LZ4FrameDecompressor  # noqa: PLC0415  an optional part

    opened = LZ4FrameDecompressor()
    unpacked = opened.decompress(packed, max_length=at_most + 1)
    if len(unpacked) > at_most or not opened.eof:
        raise ValueError("a chunk that was cut off, or that unpacks to more than any recorder's")
    return unpacked


class _Mcap:
    def __init__(self, path: Path) -> None:
        self._path = path
        with path.open("rb") as file:
            summary = _summary(file)
            if summary is None or summary.statistics is None or not summary.chunk_indexes:
                raise ValueError("no summary at its end: repair it with mcap recover")
            for chunk in summary.chunk_indexes:
                if chunk.uncompressed_size > BYTES_AT_MOST or chunk.chunk_length > _CHUNK_BYTES_AT_MOST:
                    raise ValueError("a chunk larger than any recorder's")
            types = {key: schema.name for key, schema in summary.schemas.items()}
            counts = summary.statistics.channel_message_counts
            clouds = [each for each in summary.channels.values() if types.get(each.schema_id) in _TYPES]
            topics: Counter[str] = Counter()
            for each in clouds:
                topics[each.topic] += counts.get(each.id, 0)
            topic = _busiest(topics, path)
            if topics[topic] > _MESSAGES_AT_MOST:
                raise ValueError("more messages than a recording can have")
            self._encoding = next(each.message_encoding for each in clouds if each.topic == topic)
            self._channels = {each.id for each in clouds if each.topic == topic}
            self._chunks = sorted(summary.chunk_indexes, key=lambda chunk: chunk.chunk_start_offset)
            found = islice(self._messages(file, self._chunks), _MESSAGES_AT_MOST + 1)
            self.times = sorted(message.log_time for message in found)

    def message(self, index: int) -> Any:
        time, same = self.times[index], self.times[:index].count(self.times[index])
        chunks = [each for each in self._chunks if each.message_start_time <= time <= each.message_end_time]
        with self._path.open("rb") as file:
            found = (each.data for each in self._messages(file, chunks) if each.log_time == time)
            raw = next(islice(found, same, None))
        return _decoded(raw, self._encoding)

    def _messages(self, file: BinaryIO, chunks: list[Any]) -> Iterator[Any]:
        """Read the topic's messages one by one: the library makes a list of all that a chunk says it has."""
        from mcap.data_stream import ReadDataStream  # noqa: PLC0415  an optional part
        from mcap.opcode import Opcode  # noqa: PLC0415
        from mcap.records import Message  # noqa: PLC0415

        for chunk in chunks:
            if chunk.message_index_offsets and not self._channels & chunk.message_index_offsets.keys():
                continue
            unpacked = _unpacked_chunk(file, chunk)
            stream = ReadDataStream(BytesIO(unpacked))
            while stream.count < len(unpacked):
                kind, length = stream.read1(), stream.read8()
                if kind != Opcode.MESSAGE:
                    stream.read(length)
                elif (message := Message.read(stream, length)).channel_id in self._channels:
                    yield message


def _summary(file: BinaryIO) -> Any:
    """Read the summary at a file's end; a chunk among its records, which the library would unpack, is refused."""
    from mcap.reader import FOOTER_SIZE, SeekingReader  # noqa: PLC0415  an optional part
    from mcap.records import Chunk, Footer  # noqa: PLC0415
    from mcap.stream_reader import MAGIC_SIZE, StreamReader  # noqa: PLC0415

    def records() -> Iterator[Any]:
        return StreamReader(file, skip_magic=True, emit_chunks=True, record_size_limit=BYTES_AT_MOST).records

    reader = SeekingReader(file, record_size_limit=BYTES_AT_MOST)
    file.seek(-(FOOTER_SIZE + MAGIC_SIZE), os.SEEK_END)
    footer = next(records())
    if not isinstance(footer, Footer) or not footer.summary_start:
        return None
    file.seek(footer.summary_start)
    if any(isinstance(each, Chunk) for each in records()):
        raise ValueError("a chunk in its summary")
    return reader.get_summary()


def _unpacked_chunk(file: BinaryIO, index: Any) -> bytes:
    """Read the records of a chunk, which must be of the size that the index says."""
    import zstandard  # noqa: PLC0415  an optional part
    from mcap.data_stream import ReadDataStream  # noqa: PLC0415
    from mcap.records import Chunk  # noqa: PLC0415

    file.seek(index.chunk_start_offset)
    stream = ReadDataStream(BytesIO(file.read(index.chunk_length)))
    stream.read(9)  # kind and length of the record
    chunk, size = Chunk.read(stream), index.uncompressed_size
    unpacked = chunk.data
    if chunk.compression == "lz4":
        unpacked = _unpacked_lz4(chunk.data, size)
    elif chunk.compression == "zstd" and zstandard.frame_content_size(chunk.data) <= size:
        unpacked = zstandard.decompress(chunk.data, size)  # at most that, where the frame does not say
    if not len(unpacked) == size == chunk.uncompressed_size:
        raise ValueError("a chunk that is not of the size that the index says")
    return unpacked


class _Sqlite:
    def __init__(self, path: Path) -> None:
        self._path = path
        log = path.with_name(f"{path.name}-wal")
        if log.is_file() and log.stat().st_size:
            what = f"{path}, whose last messages lie in {log.name}: the recorder did not close it"
            raise ScanError(what, "a closed recording", f"sqlite3 {path.name} 'PRAGMA wal_checkpoint(TRUNCATE)'")
        topics: Counter[str] = Counter()
        with closing(self._connected()) as database:
            kinds = dict(database.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'"))
            for table in ("topics", "messages"):  # and no view or virtual table, which could be anything
                if not str(kinds.get(table, "")).upper().startswith("CREATE TABLE"):
                    raise ValueError(f"no table {table}")
            numbers = {}
            for number, name, kind in database.execute("SELECT id, name, type FROM topics LIMIT 10000"):
                if kind in _TYPES:
                    numbers[str(name)] = int(number)
                    (count,) = database.execute(
                        "SELECT COUNT(*) FROM messages WHERE topic_id = ?", (number,)
                    ).fetchone()
                    topics[str(name)] = count
            number = numbers[_busiest(topics, path)]
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
    return _types("ROS2_FOXY").deserialize_cdr(raw, _TYPES[0])


@functools.cache  # which takes longer to make than a scan to read
def _types(release: str) -> Any:
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415  an optional part

    return get_typestore(Stores[release])


def _columns(cloud: Any) -> dict[str, np.ndarray]:
    """Return the named columns of a PointCloud2; one of several numbers a point is left alone."""
    order = ">" if cloud.is_bigendian else "<"
    fields = [each for each in cloud.fields if each.count <= 1 and each.datatype in _NUMBERS]
    kind = np.dtype(
        {
            "names": [each.name for each in fields],
            "formats": [order + _NUMBERS[each.datatype] for each in fields],
            "offsets": [each.offset for each in fields],
            "itemsize": cloud.point_step,
        }
    )
    data = np.ascontiguousarray(cloud.data, dtype=np.uint8)
    width, height, row = int(cloud.width), int(cloud.height), int(cloud.row_step)
    if width * height > POINTS_AT_MOST or width * cloud.point_step > row or row * height > len(data):
        raise ValueError(f"{width}x{height} points in {len(data)} bytes")
    rows = data[: row * height].reshape(height, row)[:, : width * cloud.point_step]
    points = np.ascontiguousarray(rows).view(kind).reshape(-1)
    return {each.name: points[each.name] for each in fields}
