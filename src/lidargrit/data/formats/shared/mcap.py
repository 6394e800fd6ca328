"""MCAP recordings: a file → messages one by one, by its index where it has a whole one, else from its records.

All that MCAP leaves to the recorder may be missing: chunks, index, statistics, and schemas and channels at the end. A
file that was cut off is read up to there.

Source:
    The MCAP format specification, https://mcap.dev/spec; the records are unpacked by the library mcap.
"""

import os
import zlib
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from typing import Any, BinaryIO, NamedTuple

from lidargrit.data.formats.shared.columns import BYTES_AT_MOST

CHUNK_BYTES_AT_MOST = 64_000_000  # as packed in the file: recorders write below 10 MB
_MAGIC_BYTES = 8
_HEAD_BYTES = 9  # of a record: kind and length
_NAMES_BYTES_AT_MOST = 10_000_000  # of a schema or a channel: message definitions take some kB
_NAMES_AT_MOST = 100_000  # schemas and channels
_KINDS = range(1, 16)  # of records that MCAP defines; from 128 on they are of others


class Place(NamedTuple):
    """A chunk, or a message outside of chunks.

    Args:
        start: position of the record in the file.
        length: size of the record, in bytes.
        unpacked: size of a chunk's records once unpacked, in bytes; -1 for a message.
        channels: channels of its messages; none if they are not known.
    """

    start: int
    length: int
    unpacked: int
    first: int
    last: int
    channels: frozenset[int] = frozenset()


class Contents(NamedTuple):
    """What a recording holds.

    Args:
        schemas: name of each schema's type, by its number.
        places: chunks and messages, in the order of the file.
        cut_at: position from which the file cannot be read; 0 if it is whole.
    """

    schemas: dict[int, str]
    channels: dict[int, Any]
    places: list[Place]
    counts: Counter[int]
    cut_at: int = 0


def contents_by_index(file: BinaryIO) -> Contents | None:
    """Read what the summary at a file's end says; None if there is none, or if it leaves anything out."""
    try:
        summary = _summary(file)
    except _ImplausibleError:
        raise
    except Exception:  # whatever a cut or damaged end makes the library stumble over
        return None
    if summary is None or (there := summary.statistics) is None:
        return None
    if len(summary.chunk_indexes) != there.chunk_count or not there.chunk_count:
        return None
    if len(summary.channels) != there.channel_count or len(summary.schemas) != there.schema_count:
        return None
    places = [
        Place(
            each.chunk_start_offset,
            each.chunk_length,
            each.uncompressed_size,
            each.message_start_time,
            each.message_end_time,
            frozenset(each.message_index_offsets),
        )
        for each in sorted(summary.chunk_indexes, key=lambda chunk: chunk.chunk_start_offset)
    ]
    for place in places:
        _check_chunk(place)
    types = {number: schema.name for number, schema in summary.schemas.items()}
    return Contents(types, summary.channels, places, Counter(there.channel_message_counts))


def contents_by_records(file: BinaryIO, types: tuple[str, ...]) -> Contents:
    """Go through the records of a file, as far as it can be read.

    Args:
        file: recording that is open for reading.
        types: types whose messages are wanted; others that lie outside of chunks are not listed.
    """
    from mcap.data_stream import ReadDataStream  # noqa: PLC0415  an optional part
    from mcap.opcode import Opcode  # noqa: PLC0415
    from mcap.records import Channel, Schema  # noqa: PLC0415

    found = Contents({}, {}, [], Counter())

    def note(kind: int, data: bytes) -> int:
        """Take over a schema or a channel; return the channel of a message, or -1."""
        if kind == Opcode.MESSAGE:
            number = int.from_bytes(data[:2], "little")
            found.counts[number] += 1
            return number
        if kind == Opcode.SCHEMA:
            schema = Schema.read(ReadDataStream(BytesIO(data)))
            found.schemas[schema.id] = schema.name
        elif kind == Opcode.CHANNEL:
            channel = Channel.read(ReadDataStream(BytesIO(data)))
            found.channels[channel.id] = channel
        if len(found.schemas) + len(found.channels) > _NAMES_AT_MOST:
            raise ValueError("more channels than a recording can have")
        return -1

    size, at = file.seek(0, os.SEEK_END), _MAGIC_BYTES
    while True:
        kind, length = _head(file, at)
        is_whole = kind in (Opcode.DATA_END, Opcode.FOOTER)
        if is_whole or at + _HEAD_BYTES + length > size or (kind not in _KINDS and kind < 128):
            return found._replace(cut_at=0 if is_whole else at)
        if kind == Opcode.CHUNK:
            first, last, unpacked = (int.from_bytes(file.read(8), "little") for _ in range(3))
            place = Place(at, _HEAD_BYTES + length, unpacked, first, last)
            _check_chunk(place)
            of_messages = {note(*record) for record in _records(unpacked_chunk(file, place))}
            found.places.append(place._replace(channels=frozenset(of_messages - {-1})))
        elif kind in (Opcode.SCHEMA, Opcode.CHANNEL) and length <= _NAMES_BYTES_AT_MOST:
            note(kind, file.read(length))
        elif kind == Opcode.MESSAGE and length >= 22:
            head = file.read(14)
            number, time = note(kind, head), int.from_bytes(head[6:], "little")
            schema = found.channels[number].schema_id if number in found.channels else -1
            if found.schemas.get(schema) in types:
                place = Place(at, _HEAD_BYTES + length, -1, time, time, frozenset({number}))
                found.places.append(place)
        at += _HEAD_BYTES + length


def messages(file: BinaryIO, places: list[Place], channels: set[int]) -> Iterator[Any]:
    """Read the messages of some channels one by one: the library makes a list of all that a chunk says it has."""
    from mcap.data_stream import ReadDataStream  # noqa: PLC0415  an optional part
    from mcap.opcode import Opcode  # noqa: PLC0415
    from mcap.records import Message  # noqa: PLC0415

    for place in places:
        if place.channels and not channels & place.channels:
            continue
        if place.unpacked < 0:
            if place.length > BYTES_AT_MOST:
                raise ValueError("a message larger than any point cloud")
            file.seek(place.start + _HEAD_BYTES)
            records = iter([(Opcode.MESSAGE, file.read(place.length - _HEAD_BYTES))])
        else:
            records = _records(unpacked_chunk(file, place))
        for kind, data in records:
            if kind == Opcode.MESSAGE and int.from_bytes(data[:2], "little") in channels:
                yield Message.read(ReadDataStream(BytesIO(data)), len(data))


def unpacked_chunk(file: BinaryIO, place: Place) -> bytes:
    """Read the records of a chunk, which must be of the size and the checksum that the file says."""
    import zstandard  # noqa: PLC0415  an optional part
    from mcap.data_stream import ReadDataStream  # noqa: PLC0415
    from mcap.records import Chunk  # noqa: PLC0415

    file.seek(place.start + _HEAD_BYTES)
    chunk, size = Chunk.read(ReadDataStream(BytesIO(file.read(place.length - _HEAD_BYTES)))), place.unpacked
    unpacked = chunk.data
    if chunk.compression == "lz4":
        unpacked = unpacked_lz4(chunk.data, size)
    elif chunk.compression == "zstd" and zstandard.frame_content_size(chunk.data) <= size:
        unpacked = zstandard.decompress(chunk.data, size)  # at most that, where the frame does not say
    if not len(unpacked) == size == chunk.uncompressed_size:
        raise ValueError("a chunk that is not of the size that the index says")
    if chunk.uncompressed_crc not in (0, computed := zlib.crc32(unpacked)):
        raise ValueError(f"a chunk of checksum {computed}, where the recorder noted {chunk.uncompressed_crc}")
    return unpacked


def unpacked_lz4(packed: bytes, at_most: int) -> bytes:
    """Unpack a frame of lz4 that must not be larger than that many bytes."""
    from lz4.frame import LZ4FrameDecompressor  # noqa: PLC0415  an optional part

    opened = LZ4FrameDecompressor()
    unpacked = opened.decompress(packed, max_length=at_most + 1)
    if len(unpacked) > at_most or not opened.eof:
        raise ValueError("a chunk that was cut off, or that unpacks to more than any recorder's")
    return unpacked


class _ImplausibleError(ValueError):
    """Something that no recorder writes, as opposed to an end that was cut off."""


def _check_chunk(place: Place) -> None:
    if place.unpacked > BYTES_AT_MOST or place.length > CHUNK_BYTES_AT_MOST:
        raise ValueError("a chunk larger than any recorder's")


def _head(file: BinaryIO, at: int) -> tuple[int, int]:
    """Return kind and length of the record at a position; kind 0, which is none, at the end of the file."""
    file.seek(at)
    head = file.read(_HEAD_BYTES)
    return (head[0], int.from_bytes(head[1:], "little")) if len(head) == _HEAD_BYTES else (0, 0)


def _records(unpacked: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at < len(unpacked):
        length = int.from_bytes(unpacked[at + 1 : at + _HEAD_BYTES], "little")
        end = at + _HEAD_BYTES + length
        if end > len(unpacked):
            raise ValueError("a chunk whose last record is cut off")
        yield unpacked[at], unpacked[at + _HEAD_BYTES : end]
        at = end


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
    if footer.summary_crc:
        checked = file.read(BYTES_AT_MOST)[: -(MAGIC_SIZE + 4)]  # all up to the checksum itself
        if zlib.crc32(checked) != footer.summary_crc:
            return None
        file.seek(footer.summary_start)
    if any(isinstance(each, Chunk) for each in records()):
        raise _ImplausibleError("a chunk in its summary")
    return reader.get_summary()
