"""One file of many range images ⇄ pixels: range in whole steps, reflectance in bytes, each image compressed alone.

A shard is the magic, the compressed images one after another, an index in JSON, the index's length in 8 bytes, and the
magic again; so it is written in one go, is whole or not there, and one image is read by one seek, here or far away.
"""

from __future__ import annotations

import hashlib
import json
import math
import mmap
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO, Protocol, runtime_checkable

import numpy as np
from numcodecs.blosc import SHUFFLE, Blosc

from lidargrit.errors import DataError
from lidargrit.loading.images import Pixels
from lidargrit.sensors import SensorModel
from lidargrit.structures import RangeImage

_MAGIC = b"LGSHARD1"
_TAIL = 8 + len(_MAGIC)
_INDEX_AT_MOST = 1 << 26  # bytes; a shard of a hundred images has an index of ten thousand
_FINEST_STEP_M = 0.002  # a tenth of the scatter of a good sensor; 16 bits of it reach 131 m
_BLOSC_HEADER = 16  # bytes: at 4 the size of the pixels, at 12 that of the blob (Blosc 1 chunk format)
# 98 KB for a KITTI scan as 64x1024, read in 0.16 ms; level 1 takes 4 % more room, level 5 no less.
_CODEC = Blosc(cname="zstd", clevel=3, shuffle=SHUFFLE)


@dataclass(frozen=True)
class Entry:
    """Where one image lies in a shard.

    Args:
        scan: which of the planned scans it is.
        offset: of its first byte in the file.
        range_bytes: length of its compressed range.
        reflectance_bytes: length of its compressed reflectance, which follows; 0 if it has none.
        fingerprint: of its pixels before compression.
    """

    scan: int
    offset: int
    range_bytes: int
    reflectance_bytes: int
    fingerprint: str


@runtime_checkable
class Bytes(Protocol):
    """A file to read pieces of, on this machine or on another."""

    size: int

    def read(self, start: int, end: int) -> bytes | memoryview:
        """Return the bytes from ``start`` up to ``end``."""
        ...


class LocalBytes:
    """A file of this machine, mapped into memory."""

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self.size = len(self._map)

    def read(self, start: int, end: int) -> memoryview:
        """Return the bytes from ``start`` up to ``end``, without a copy."""
        return memoryview(self._map)[start:end]


def range_step_m(sensor: SensorModel) -> float:
    """Return the step in which ranges of a sensor are kept: 2 mm, or as many more as its reach needs."""
    needed = math.ceil(sensor.range_max_m / (_FINEST_STEP_M * np.iinfo(np.uint16).max))
    return _FINEST_STEP_M * max(1, needed)


class ShardWriter:
    """Writes images and then the index into an open file."""

    def __init__(self, file: BinaryIO, step_m: float) -> None:
        self._file, self._step_m = file, step_m
        self._entries: list[Entry] = []
        self._left_out: dict[int, str] = {}
        self._offset = file.write(_MAGIC)

    def add(self, scan: int, image: RangeImage) -> None:
        """Write one image."""
        steps = np.rint(image.range_m.numpy() / np.float32(self._step_m)).astype(np.uint16)
        steps[image.return_mask.numpy() & (steps == 0)] = 1  # a return stays one
        known = image.reflectance is not None
        levels = np.rint(image.reflectance.numpy() * 255).astype(np.uint8) if image.reflectance is not None else None
        range_blob = _compress(steps)
        reflectance_blob = _compress(levels) if levels is not None else b""
        fingerprint = hashlib.blake2b(steps.tobytes(), digest_size=8)
        fingerprint.update(levels.tobytes() if levels is not None else b"")
        self._entries.append(
            Entry(scan, self._offset, len(range_blob), len(reflectance_blob) * known, fingerprint.hexdigest())
        )
        self._offset += self._file.write(range_blob) + self._file.write(reflectance_blob)

    def leave_out(self, scan: int, why: str) -> None:
        """Note that a scan cannot be used."""
        self._left_out[scan] = why

    def finish(self) -> None:
        """Write the index."""
        index = json.dumps({"entries": [asdict(e) for e in self._entries], "left_out": self._left_out}).encode()
        self._file.write(index + len(index).to_bytes(8, "little") + _MAGIC)


def read_index(file: Bytes, name: str) -> tuple[list[Entry], dict[int, str]]:
    """Return where the images of a shard lie, and which scans were left out and why.

    Raises:
        DataError: the file is no whole shard.
    """
    try:
        tail = bytes(file.read(max(0, file.size - _TAIL), file.size))
        length = int.from_bytes(tail[:8], "little")
        start = file.size - _TAIL - length
        if tail[8:] != _MAGIC or not len(_MAGIC) <= start or length > _INDEX_AT_MOST:
            raise ValueError("no index at its end")
        index = json.loads(bytes(file.read(start, file.size - _TAIL)))
        entries = [Entry(**entry) for entry in index["entries"]]
        for entry in entries:
            if min(entry.offset, entry.range_bytes, entry.reflectance_bytes) < 0:
                raise ValueError("a negative length")
            if entry.offset + entry.range_bytes + entry.reflectance_bytes > start:
                raise ValueError("an image beyond its end")
        return entries, {int(scan): str(why) for scan, why in index["left_out"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise _damaged(name, error) from None


def read_image(
    file: Bytes, entry: Entry, shape: tuple[int, int], step_m: float, name: str, verify: bool = False
) -> Pixels:
    """Return one image of a shard; ``verify`` compares its pixels with their fingerprint.

    Raises:
        DataError: the image is damaged.
    """
    middle = entry.offset + entry.range_bytes
    try:
        steps = _decompress(file.read(entry.offset, middle), shape, np.uint16)
        levels = None
        if entry.reflectance_bytes:
            levels = _decompress(file.read(middle, middle + entry.reflectance_bytes), shape, np.uint8)
    except (OSError, ValueError, RuntimeError, TypeError) as error:
        raise _damaged(name, error) from None
    if verify:
        fingerprint = hashlib.blake2b(steps.tobytes(), digest_size=8)
        fingerprint.update(levels.tobytes() if levels is not None else b"")
        if fingerprint.hexdigest() != entry.fingerprint:
            raise _damaged(name, ValueError("pixels that differ from their fingerprint"))
    range_m = np.multiply(steps, np.float32(step_m), dtype=np.float32)
    return range_m, None if levels is None else np.multiply(levels, np.float32(1 / 255), dtype=np.float32)


def _compress(pixels: np.ndarray) -> bytes:
    return _CODEC.encode(np.ascontiguousarray(pixels))


def _decompress(blob: bytes | memoryview, shape: tuple[int, int], dtype: type) -> np.ndarray:
    pixels = np.empty(shape, dtype)
    header = bytes(blob[:_BLOSC_HEADER])
    size, length = int.from_bytes(header[4:8], "little"), int.from_bytes(header[12:16], "little")
    if size != pixels.nbytes or length != len(blob):  # the library would trust these
        raise ValueError(f"{size} bytes of pixels for an image of {pixels.nbytes}")
    _CODEC.decode(blob, pixels)
    return pixels


def _damaged(name: str, error: Exception) -> DataError:
    return DataError(
        f"{name}, a damaged shard ({error})", "what lidargrit prepare wrote", "remove it and prepare again"
    )
