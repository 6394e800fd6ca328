"""Images of a prepared folder ⇄ Zarr arrays: ranges in steps, reflectance in bytes, classes in 16 bits.

``images.zarr`` has the arrays range, reflectance and label with the axes scan, row and column. A chunk is one image
with its checksum, a file is one shard of chunks. tensorstore writes and reads them, and other programs for Zarr 3 can.
"""

import hashlib
import math
import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lidargrit.core.errors import DataError
from lidargrit.data.images import Pixels
from lidargrit.data.prepared.plan import ARRAYS, STORED_AS, ImageFacts, PreparedSpec
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage

if TYPE_CHECKING:
    from tensorstore import Context, TensorStore

_FINEST_STEP_M = 0.002  # a tenth of the scatter of a good sensor; 16 bits of it reach 131 m
_RETRIES = {"max_retries": 5}  # of a request to a store; the library's own 32 would take many minutes
_CACHE_BYTES = 2**26
_DAMAGED = ("DATA_LOSS", "FAILED_PRECONDITION", "OUT_OF_RANGE", "INVALID_ARGUMENT", "NOT_FOUND")  # codes of the library


def range_step_m(sensor: SensorModel) -> float:
    """Return the step in which ranges of a sensor are kept: 2 mm, or a multiple that its reach needs."""
    needed = math.ceil(sensor.range_max_m / (_FINEST_STEP_M * np.iinfo(np.uint16).max))
    return _FINEST_STEP_M * max(1, needed)


@cache
def store_context(is_far: bool) -> "Context":
    """Return the library's settings for stores on this machine, or for those far away, whose indices are kept."""
    import tensorstore  # noqa: PLC0415  quick start of commands that read no prepared scans

    retries = {f"{store}_request_retries": _RETRIES for store in ("http", "s3", "gcs")}
    return tensorstore.Context({"cache_pool": {"total_bytes_limit": _CACHE_BYTES if is_far else 0}, **retries})


def store_of(location: str) -> dict[str, Any]:
    """Return the library's description of a folder on this machine, or behind a URL, with a slash at its end."""
    if "://" not in location:
        return {"driver": "file", "path": f"{location}/"}
    import tensorstore  # noqa: PLC0415  quick start of commands that read no prepared scans

    try:
        store = tensorstore.KvStore.Spec(f"{location.rstrip('/')}/").to_json()
    except ValueError as error:
        raise DataError(f"{location} ({told(error)})", "s3://, gs://, http:// or https://", "check it") from None
    return store | _of_environment() if store["driver"] == "s3" else store


def _of_environment() -> dict[str, Any]:
    """Return what variables say of S3: the library does not know all, and tells of files that it need not look for."""
    found, variables = dict[str, Any](), os.environ
    if endpoint := variables.get("AWS_ENDPOINT_URL_S3") or variables.get("AWS_ENDPOINT_URL"):
        region = variables.get("AWS_REGION") or variables.get("AWS_DEFAULT_REGION") or "us-east-1"
        found = {"endpoint": endpoint, "aws_region": region}
    return found | {"aws_credentials": {"type": "environment"}} if variables.get("AWS_ACCESS_KEY_ID") else found


def told(error: Exception) -> str:
    """Return what the library tells of an error, without its own settings, on one line."""
    return " ".join(str(error).partition(" [")[0].split())[:300]


@contextmanager
def store_errors(location: str) -> Iterator[None]:
    """Raise what the library tells of damage, or of a store out of reach, as DataError."""
    try:
        yield
    except DataError:
        raise
    except ValueError as error:
        if str(error).startswith(_DAMAGED):
            raise damaged(location, told(error)) from None
        raise DataError(
            f"{location}, which cannot be read ({told(error)})",
            "a store that can be reached with your credentials",
            "check its address and the credentials, then give the same command again",
        ) from None


def damaged(location: str, why: str) -> DataError:
    """Return the error of a prepared folder whose files are not as they were written."""
    wanted = "what lidargrit prepare wrote"
    return DataError(f"{location}, damaged ({why})", wanted, "prepare it again with --verify, which makes it good")


class ImageArrays:
    """Arrays of the images of a prepared folder.

    Args:
        location: path or URL of the folder.
        spec: plan of the folder.
    """

    def __init__(self, location: str, spec: PreparedSpec) -> None:
        self.location, self._spec = f"{location}/{ARRAYS}", spec
        self._store = store_of(location)
        self._is_far = self._store["driver"] != "file"
        sensor = SensorModel.from_json(spec.sensor)
        self._shape = sensor.height, sensor.width
        self._arrays: dict[str, TensorStore] = {}
        self._lock = threading.Lock()

    def write(self, first: int, planes: Mapping[str, np.ndarray]) -> None:
        """Write images from a scan on; a kill leaves each file of a shard as it was, or whole.

        Args:
            first: index of the first scan.
            planes: arrays (scan, row, column) by their names.

        Raises:
            OSError: the disk is full, or the folder cannot be written to.
        """
        try:
            for name, pixels in planes.items():
                self._array(name, create=True)[first : first + len(pixels)].write(pixels).result()
        except DataError:
            raise
        except ValueError as error:
            raise OSError(told(error)) from error

    def read(self, facts: ImageFacts, planes: tuple[str, ...], verify: bool = False) -> Pixels:
        """Return some planes of one image; several threads may call it at once.

        Args:
            verify: whether to compare the pixels with their fingerprint.
        """
        with store_errors(self.location):
            reads = {name: self._array(name)[facts.scan].read() for name in planes}
            stored = {name: reading.result() for name, reading in reads.items()}
        # What is not there reads as zeros.
        if verify or not all(plane.any() for plane in stored.values()):
            self._verify(facts, stored)
        range_m = np.multiply(stored["range"], np.float32(self._spec.range_step_m), dtype=np.float32)
        kept = {name: plane for name, plane in stored.items() if name != "range"}
        if "reflectance" in kept:
            kept["reflectance"] = np.multiply(kept["reflectance"], np.float32(1 / 255), dtype=np.float32)
        return Pixels(range_m, kept)

    def _verify(self, facts: ImageFacts, stored: Mapping[str, np.ndarray]) -> None:
        found = facts_of(facts.scan, stored, facts.full_scale)
        same = found.range_fingerprint == facts.range_fingerprint
        same &= "reflectance" not in stored or found.fingerprint == facts.fingerprint
        same &= "label" not in stored or found.label_fingerprint == facts.label_fingerprint
        if not same:
            raise damaged(self.location, f"pixels of scan {facts.scan} that differ from their fingerprint")

    def _array(self, name: str, create: bool = False) -> "TensorStore":
        import tensorstore  # noqa: PLC0415  quick start of commands that read no prepared scans

        with self._lock:
            if name not in self._arrays:
                if not self._is_far:
                    _refuse_pipes(Path(self.location, name))
                context = store_context(self._is_far)
                opened = tensorstore.open(self._described(name), open=True, create=create, context=context)
                self._arrays[name] = opened.result()
            return self._arrays[name]

    def _described(self, name: str) -> dict[str, Any]:
        """Return the array's description: an array that is there and differs in any part of it is not opened."""
        image, numbers = [1, *self._shape], {"name": "bytes", "configuration": {"endian": "little"}}
        typesize, checksum = np.dtype(STORED_AS[name]).itemsize, {"name": "crc32c"}
        # 98 KB for a KITTI scan as 64x1024; level 1 takes 4 % more room, level 5 no less.
        settings = {"cname": "zstd", "clevel": 3, "shuffle": "shuffle", "typesize": typesize, "blocksize": 0}
        chunk = [numbers if typesize > 1 else {"name": "bytes"}, {"name": "blosc", "configuration": settings}, checksum]
        shard = {"chunk_shape": image, "codecs": chunk, "index_codecs": [numbers, checksum], "index_location": "end"}
        grid = {"name": "regular", "configuration": {"chunk_shape": [self._spec.shard_scans, *self._shape]}}
        steps = {"range": {"step_m": self._spec.range_step_m}, "reflectance": {"step": 1 / 255}}
        return {
            "driver": "zarr3",
            "recheck_cached_data": not self._is_far,
            "kvstore": {**self._store, "path": f"{self._store['path']}{ARRAYS}/{name}/"},
            "store_data_equal_to_fill_value": True,  # else a shard of zeros could not be told from one that is lost
            "metadata": {
                "shape": [self._spec.num_scans, *self._shape],
                "data_type": STORED_AS[name],
                "fill_value": 0,
                "chunk_grid": grid,
                "chunk_key_encoding": {"name": "default", "configuration": {"separator": "."}},
                "codecs": [{"name": "sharding_indexed", "configuration": shard}],
                "dimension_names": ["scan", "row", "column"],
                "attributes": steps.get(name, {}),
            },
        }


def _refuse_pipes(folder: Path) -> None:
    """Refuse what the library would wait for without end."""
    entries = [*os.scandir(folder)] if folder.is_dir() else []
    if pipe := next((entry.path for entry in entries if not entry.is_file() and Path(entry).is_fifo()), None):
        raise DataError(f"{pipe}, a named pipe", "what lidargrit prepare wrote", "remove it, and prepare again")


def stored(image: RangeImage, step_m: float) -> dict[str, np.ndarray]:
    """Return the planes of an image as they are stored."""
    steps = np.rint(image.range_m.numpy() / np.float32(step_m)).astype(np.uint16)
    steps[image.return_mask.numpy() & (steps == 0)] = 1  # a return stays one
    planes: dict[str, np.ndarray] = {"range": steps}
    if image.reflectance is not None:
        planes["reflectance"] = np.rint(image.reflectance.numpy() * 255).astype(np.uint8)
    if image.label is not None:
        planes["label"] = image.label.numpy().astype(np.uint16)
    return planes


def facts_of(scan: int, planes: Mapping[str, np.ndarray], full_scale: int) -> ImageFacts:
    """Return the facts of an image whose planes are as :func:`stored` gives them."""
    of_ranges = of_pixels = _fingerprint(planes["range"])
    if "reflectance" in planes:
        of_pixels = _fingerprint(planes["range"], planes["reflectance"])
    of_classes = _fingerprint(planes["label"]) if "label" in planes else ""
    return ImageFacts(scan, of_pixels, of_ranges, of_classes, full_scale)


def _fingerprint(*parts: np.ndarray) -> str:
    digest = hashlib.blake2b(digest_size=8)
    for part in parts:
        digest.update(part.tobytes())
    return digest.hexdigest()
