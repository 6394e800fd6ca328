"""One file of many range images ⇄ pixels: range in steps, reflectance in bytes, class in 16 bits, each image by itself.

A shard is the magic, the compressed images one after another, an index in JSON, the index's length in 8 bytes, and the
magic again. A file that was cut short is recognised by its end, and one image is read by one seek, here or far away.
"""

import errno
import hashlib
import json
import math
import mmap
import resource
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np

from lidargrit.core.errors import DataError
from lidargrit.core.files import atomic_path
from lidargrit.core.untrusted import JSON_BYTES_AT_MOST, parse_json
from lidargrit.data.images import Pixels
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage

if TYPE_CHECKING:
    from numcodecs.blosc import Blosc

_MAGIC = b"LGSHARD1"
_TAIL = 8 + len(_MAGIC)
_FINEST_STEP_M = 0.002  # a tenth of the scatter of a good sensor; 16 bits of it reach 131 m
_BLOSC_HEADER = 16  # bytes: at 4 the size of the pixels, at 12 that of the blob (Blosc 1 chunk format)


@dataclass(frozen=True)
class ShardEntry:
    """Position of one image in a shard, and its hashes.

    Args:
        scan: index of the image's scan among all scans of the prepared folder.
        offset: position of the image's first byte in the file.
        range_bytes: length of the compressed range, in bytes.
        reflectance_bytes: length of the compressed reflectance, in bytes, which follows the range; 0 if there is none.
        fingerprint: hash of the pixels before compression.
        range_fingerprint: hash of the ranges alone, by which a scan without its reflectance is recognised.
        label_bytes: length of the compressed classes, in bytes, which come last; 0 if there are none.
        label_fingerprint: hash of the classes; "" if there are none. A scan is the same with labels or without.
        full_scale: number that the reflectance of the scan's file was divided by because its largest value fits; 0 if
            that had not to tell.
    """

    scan: int
    offset: int
    range_bytes: int
    reflectance_bytes: int
    fingerprint: str
    range_fingerprint: str
    label_bytes: int
    label_fingerprint: str
    full_scale: int = 0  # format 4 did not have it from the first

    @property
    def end(self) -> int:
        """Position after the image's last byte."""
        return self.offset + self.range_bytes + self.reflectance_bytes + self.label_bytes


@runtime_checkable
class Bytes(Protocol):
    """A file, on this machine or on another, of which pieces can be read."""

    size: int

    def read(self, start: int, end: int) -> bytes | memoryview:
        """Return the bytes from ``start`` up to ``end``."""
        ...


class LocalBytes:
    """A file of this machine, mapped into memory."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():  # a pipe would hang
            raise FileNotFoundError("no such file" if not path.exists() else "not a file")
        try:
            self._map = _mapped(path)
        except OSError as error:
            if error.errno != errno.EMFILE:
                raise
            _, most = resource.getrlimit(resource.RLIMIT_NOFILE)  # many systems allow 1,024 files until one asks
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
            self._map = _mapped(path)
        self.size = len(self._map)

    def read(self, start: int, end: int) -> memoryview:
        """Return the bytes from ``start`` up to ``end``, without copying them."""
        return memoryview(self._map)[start:end]


def _mapped(path: Path) -> mmap.mmap:
    with path.open("rb") as file:
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


def range_step_m(sensor: SensorModel) -> float:
    """Return the step in which ranges of a sensor are kept: 2 mm, or a multiple that its reach needs."""
    needed = math.ceil(sensor.range_max_m / (_FINEST_STEP_M * np.iinfo(np.uint16).max))
    return _FINEST_STEP_M * max(1, needed)


class ShardWriter:
    """Collects compressed images in memory and writes them as one file.

    Args:
        step_m: step in which ranges are kept, in metres.
    """

    def __init__(self, step_m: float) -> None:
        self._step_m = step_m
        self._entries: list[ShardEntry] = []
        self._blobs: list[bytes] = []  # of the same images, each its range, then its reflectance, then its classes
        self._left_out: dict[int, str] = {}
        self._end = len(_MAGIC)

    @property
    def scans(self) -> set[int]:
        """Indices of the scans that have been added or left out."""
        return {entry.scan for entry in self._entries} | self._left_out.keys()

    def add(self, scan: int, image: RangeImage, full_scale: int = 0) -> None:
        """Add the image of a scan; for ``full_scale`` see :class:`ShardEntry`."""
        steps = np.rint(image.range_m.numpy() / np.float32(self._step_m)).astype(np.uint16)
        steps[image.return_mask.numpy() & (steps == 0)] = 1  # a return stays one
        levels = None if image.reflectance is None else np.rint(image.reflectance.numpy() * 255).astype(np.uint8)
        classes = None if image.label is None else image.label.numpy().astype(np.uint16)
        blobs = [b"" if one is None else _compress(one) for one in (steps, levels, classes)]
        of_ranges = _fingerprint(steps)
        of_pixels = of_ranges if levels is None else _fingerprint(steps, levels)
        of_classes = "" if classes is None else _fingerprint(classes)
        of_range, of_reflectance, of_label = map(len, blobs)
        self._append(
            ShardEntry(
                scan, self._end, of_range, of_reflectance, of_pixels, of_ranges, of_label, of_classes, full_scale
            ),
            b"".join(blobs),
        )

    def add_from(self, file: Bytes, name: str) -> None:
        """Add all that another file of this class holds."""
        entries, left_out = read_index(file, name)
        for entry in entries:
            blob = file.read(entry.offset, entry.end)
            self._append(replace(entry, offset=self._end), bytes(blob))
        self._left_out |= left_out

    def leave_out(self, scan: int, why: str) -> None:
        """Note that a scan cannot be used."""
        self._left_out[scan] = why

    def write(self, path: Path) -> None:
        """Write all of it into a file, which appears whole; more may be added afterwards."""
        contents = {"entries": [asdict(entry) for entry in self._entries], "left_out": self._left_out}
        index = json.dumps(contents).encode()
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            file.writelines((_MAGIC, *self._blobs, index, len(index).to_bytes(8, "little"), _MAGIC))

    def _append(self, entry: ShardEntry, blob: bytes) -> None:
        self._entries.append(entry)
        self._blobs.append(blob)
        self._end += len(blob)


def read_index(file: Bytes, name: str) -> tuple[list[ShardEntry], dict[int, str]]:
    """Return the entries of a shard's images, and for each scan that was left out the reason."""
    tail = bytes(file.read(max(0, file.size - _TAIL), file.size))
    length = int.from_bytes(tail[:8], "little")
    start = file.size - _TAIL - length
    if tail[8:] != _MAGIC or not len(_MAGIC) <= start or length > JSON_BYTES_AT_MOST:
        raise _damaged(name, ValueError("no index at its end"))
    data = bytes(file.read(start, file.size - _TAIL))
    try:
        index = parse_json(data, "its index")
        entries = [ShardEntry(**entry) for entry in index["entries"]]
        for entry in entries:
            lengths = entry.range_bytes, entry.reflectance_bytes, entry.label_bytes
            numbers = entry.scan, entry.offset, *lengths, entry.full_scale
            if not all(type(number) is int and number >= 0 for number in numbers):
                raise ValueError("lengths that are no whole numbers")
            hashes = entry.fingerprint, entry.range_fingerprint, entry.label_fingerprint
            if not all(isinstance(one, str) for one in hashes):
                raise ValueError("a fingerprint that is none")
            if entry.end > start:
                raise ValueError("an image beyond its end")
        return entries, {int(scan): str(why) for scan, why in index["left_out"].items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise _damaged(name, error) from None


def read_image(
    file: Bytes, entry: ShardEntry, shape: tuple[int, int], step_m: float, name: str, verify: bool = False
) -> Pixels:
    """Return the pixels of one image of a shard; ``verify`` compares them with their fingerprint."""
    blob = file.read(entry.offset, entry.end)
    of_range, of_reflectance = entry.range_bytes, entry.range_bytes + entry.reflectance_bytes
    try:
        steps = _decompress(blob[:of_range], shape, np.uint16)
        levels = _decompress(blob[of_range:of_reflectance], shape, np.uint8) if entry.reflectance_bytes else None
        classes = _decompress(blob[of_reflectance:], shape, np.uint16) if entry.label_bytes else None
    except (ValueError, RuntimeError, TypeError) as error:
        raise _damaged(name, error) from None
    if verify:
        hashes = _fingerprint(steps, levels), "" if classes is None else _fingerprint(classes)
        if hashes != (entry.fingerprint, entry.label_fingerprint):
            raise _damaged(name, ValueError("pixels that differ from their fingerprint"))
    range_m = np.multiply(steps, np.float32(step_m), dtype=np.float32)
    planes = {} if levels is None else {"reflectance": np.multiply(levels, np.float32(1 / 255), dtype=np.float32)}
    return Pixels(range_m, planes if classes is None else {**planes, "label": classes})


def _fingerprint(*parts: np.ndarray | None) -> str:
    digest = hashlib.blake2b(digest_size=8)
    for part in parts:
        digest.update(b"" if part is None else part.tobytes())
    return digest.hexdigest()


@cache
def _codec() -> "Blosc":
    from numcodecs.blosc import SHUFFLE, Blosc  # noqa: PLC0415  training from images in memory needs no compression

    # 98 KB for a KITTI scan as 64x1024, read in 0.16 ms; level 1 takes 4 % more room, level 5 no less.
    return Blosc(cname="zstd", clevel=3, shuffle=SHUFFLE)


def _compress(pixels: np.ndarray) -> bytes:
    return _codec().encode(np.ascontiguousarray(pixels))


def _decompress(blob: bytes | memoryview, shape: tuple[int, int], dtype: type) -> np.ndarray:
    pixels = np.empty(shape, dtype)
    header = bytes(blob[:_BLOSC_HEADER])
    size, length = int.from_bytes(header[4:8], "little"), int.from_bytes(header[12:16], "little")
    if size != pixels.nbytes or length != len(blob):  # the library would trust these
        raise ValueError(f"{size} bytes of pixels for an image of {pixels.nbytes}")
    _codec().decode(blob, pixels)
    return pixels


def _damaged(name: str, error: Exception) -> DataError:
    return DataError(
        f"{name}, a damaged shard ({error})", "what lidargrit prepare wrote", "remove it and prepare again"
    )
