"""A prepared folder, on this machine or behind a URL, with a plan and shards → range images."""

import copy
import threading
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import ConfigError, DataError, counted_scans
from lidargrit.core.untrusted import JSON_BYTES_AT_MOST, parse_json, user_path
from lidargrit.data.images import ImageStore, Pixels, Provenance
from lidargrit.data.prepared.shards import Bytes, LocalBytes, ShardEntry, range_step_m, read_image, read_index
from lidargrit.scans.sensors import SensorModel


class FewerColumns:
    """Images of a store whose columns are gathered into fewer: of each new pixel, the nearest return stays.

    Where the number of columns falls to a whole part, these are the pixels that a projection of the points gives, but
    that of two returns in one step of the stored ranges either may stay.
    Otherwise a return goes to the new column in which the centre of its old one lies, up to half an old column from
    where its point lay.

    Args:
        images: store of images that are ``columns`` wide.
        columns: number of columns of the stored images.
        wanted: number of columns of the new images, at most as many.
    """

    def __init__(self, images: ImageStore, columns: int, wanted: int) -> None:
        self._images, self.provenance = images, images.provenance
        new_column = (np.arange(columns) * 2 + 1) * wanted // (2 * columns)
        self._first = np.searchsorted(new_column, np.arange(wanted))
        self._counts = np.diff(self._first, append=columns)

    def __len__(self) -> int:
        return len(self._images)

    def read(self, index: int) -> Pixels:
        """Return the pixels of one image."""
        range_m, planes = self._images.read(index)
        nearest_m = np.minimum.reduceat(np.where(range_m > 0, range_m, np.inf), self._first, axis=1)
        returned = np.isfinite(nearest_m)
        kept = dict[str, np.ndarray]()
        if planes:
            column = np.arange(range_m.shape[1])
            is_nearest = range_m == np.repeat(nearest_m, self._counts, axis=1)
            # Stored ranges have steps, so that several may be the nearest: the first gives its planes.
            found = np.minimum.reduceat(np.where(is_nearest, column, column[-1]), self._first, axis=1)
            for name, pixels in planes.items():
                kept[name] = np.where(returned, np.take_along_axis(pixels, found, axis=1), 0)
        return Pixels(np.where(returned, nearest_m, 0).astype(np.float32), kept)


def has_fewer_columns(sensor: SensorModel, other: SensorModel) -> bool:
    """Tell whether a sensor looks along another's rows, in fewer equal columns; both with all their fine columns."""
    if sensor.width >= other.width:
        return False
    try:
        return other.with_columns(sensor.width).same_rays(sensor)
    except ConfigError:  # a sensor with angles for every pixel
        return False


PLAN_FILE, SCANS_FILE = "plan.json", "scans.json"
FORMAT = 4  # to be raised whenever projection or simulation give other pixels for the same scan
_OPENED_AT_ONCE = 16  # shards: a store takes some hundredths of a second for each
_LIST_BYTES_AT_MOST = 2**28  # the list of a million scans takes half of it


@dataclass(frozen=True)
class PreparedSpec:
    """Everything that the pixels of a prepared folder depend on; ``plan.json`` holds it under these names.

    Args:
        format: number of the format, raised whenever projection or simulation gives other pixels for the same scan.
        version: version of lidargrit.
        source: source of the scans, as the user typed it.
        sensor: JSON of the sensor, with all its fine columns.
        variant: projection variant, ``exact`` or ``reference``.
        bad_points: treatment of bad points, ``refuse`` or ``drop``.
        bad_scans: treatment of bad scans, ``refuse`` or ``skip``.
        max_scans: largest number of scans taken from the source, evenly spaced; 0 for all.
        range_step_m: step in which ranges are kept, in metres.
        shard_scans: number of scans in a shard; the last shard may have fewer.
        num_scans: number of scans in the folder, those left out included.
        digest: hash of the names, sizes and times of the scans' files.
    """

    format: int
    version: str
    source: str
    sensor: dict[str, Any]
    variant: str
    bad_points: str
    bad_scans: str
    max_scans: int
    range_step_m: float
    shard_scans: int
    num_scans: int
    digest: str

    @property
    def num_shards(self) -> int:
        """Number of shards."""
        return -(-self.num_scans // self.shard_scans)

    def scans_of(self, shard: int) -> range:
        """Return the indices of one shard's scans among all scans."""
        return range(shard * self.shard_scans, min((shard + 1) * self.shard_scans, self.num_scans))

    def is_shard(self, shard: int, entries: Iterable[ShardEntry], left_out: Iterable[int]) -> bool:
        """Return whether an index, of images and of scans that were left out, is that of a shard."""
        return sorted([*(entry.scan for entry in entries), *left_out]) == list(self.scans_of(shard))

    def differences(self, other: "PreparedSpec") -> list[str]:
        """Return the names of the fields that differ from another's."""
        mine, theirs = asdict(self), asdict(other)
        return [name for name in mine if mine[name] != theirs[name]]


def shard_name(shard: int) -> str:
    """Return the file name of a shard."""
    return f"{shard:06d}.shard"


def unfinished_name(shard: int) -> str:
    """Return the name of the file that holds the finished part of a shard."""
    return f"{shard:06d}.unfinished"


def is_prepared(source: str) -> bool:
    """Return whether a source is where prepared scans lie: a URL, or a folder with a plan."""
    try:
        return "://" in source or (user_path(source) / PLAN_FILE).is_file()
    except (OSError, DataError):  # no file can be called so, or no home folder is there
        return False


class PreparedFolder:
    """The files of a prepared folder, on this machine or behind a URL.

    Args:
        location: path on this machine, or a URL that fsspec opens, such as s3://bucket/scans.
    """

    def __init__(self, location: str) -> None:
        self.location = location
        self._is_local = "://" not in location
        if not self._is_local:
            import fsspec  # noqa: PLC0415  only for what is far away

            try:
                self._files, self._root = fsspec.core.url_to_fs(location)
            except (ValueError, ImportError, OSError) as error:
                raise DataError(f"{location} ({error})", "a URL that fsspec can open", "check it") from None

    def open(self, name: str) -> Bytes:
        """Open a file, of which pieces can then be read."""
        if not self._is_local:
            return _RemoteBytes(self._files, f"{self._root}/{name}", f"{self.location}/{name}")
        try:
            return LocalBytes(user_path(self.location) / name)
        except (OSError, ValueError) as error:  # an empty file cannot be mapped
            raise DataError(
                f"{self.location}/{name}, which cannot be read ({error})", "what lidargrit prepare wrote", "prepare it"
            ) from None

    def read_json(self, name: str, kind: type = dict, at_most: int = JSON_BYTES_AT_MOST) -> Any:
        """Read a whole JSON file of bounded size and depth.

        Args:
            kind: required type of the whole, dict or list.
            at_most: largest size, in bytes.
        """
        file = self.open(name)
        data, wanted = bytes(file.read(0, min(file.size, at_most + 1))), "what lidargrit prepare wrote"
        return parse_json(data, f"{self.location}/{name}", kind, DataError, wanted, "prepare again", at_most)

    def read_spec(self) -> PreparedSpec:
        """Read what the images were prepared from and how, or raise DataError."""
        try:
            entries = self.read_json(PLAN_FILE)
            spec = PreparedSpec(**entries)
            for field in fields(PreparedSpec):  # the plain types; the sensor checks itself
                kind = {int: int, float: (int, float), str: str}.get(field.type, dict)
                if not isinstance(getattr(spec, field.name), kind) or isinstance(getattr(spec, field.name), bool):
                    raise TypeError(f"{field.name} is {getattr(spec, field.name)!r:.40}")
            if spec.format != FORMAT or min(spec.shard_scans, spec.num_scans) < 1:
                raise TypeError(f"format {spec.format}, {spec.num_scans} scans by {spec.shard_scans}")
            return spec
        except TypeError as error:
            raise DataError(
                f"{self.location}/{PLAN_FILE}, which is no plan ({error})", "one of this version", "prepare again"
            ) from None


def _is_named(scan: Any) -> bool:
    """Return whether an entry of the list of scans begins with the scan's name and its recording."""
    return isinstance(scan, list) and len(scan) >= 2 and isinstance(scan[0], str) and isinstance(scan[1], str)


class _RemoteBytes:
    """A file in a store that fsspec knows, such as an S3 bucket."""

    def __init__(self, files: Any, path: str, url: str) -> None:
        self._files, self._path, self._url = files, path, url
        with self._store_errors():
            self.size = int(files.info(path)["size"])

    def read(self, start: int, end: int) -> bytes:
        """Return the bytes from ``start`` up to ``end``."""
        with self._store_errors():  # by keyword: some stores have a version of the file before the start
            return self._files.cat_file(self._path, start=start, end=end)

    @contextmanager
    def _store_errors(self) -> Iterator[None]:
        try:
            yield
        except FileNotFoundError:
            raise DataError(
                f"{self._url}, which does not exist", "what lidargrit prepare wrote", "prepare it, or check the URL"
            ) from None
        except Exception as error:  # the library of every store has errors of its own
            raise DataError(
                f"{self._url}, which cannot be read ({type(error).__name__}: {error})",
                "a store that can be reached with your credentials",
                "check its address and the credentials, then give the same command again",
            ) from None


class PreparedImages:
    """The range images of a prepared folder.

    Args:
        location: path of the folder, or its URL.
    """

    def __init__(self, location: str) -> None:
        self._folder = PreparedFolder(location)
        self.spec = self._folder.read_spec()
        self.sensor = SensorModel.from_json(self.spec.sensor)
        if self.spec.range_step_m != range_step_m(self.sensor):  # pixels are numbers of steps
            raise DataError(
                f"{location}/{PLAN_FILE}, whose range_step_m is another than its sensor's",
                f"{range_step_m(self.sensor):g} m",
                "prepare again",
            )
        self._shape = (self.sensor.height, self.sensor.width)
        self._entries: list[tuple[int, ShardEntry]] = []
        self.left_out: dict[int, str] = {}
        self._open: dict[int, Bytes] = {}
        self._lock = threading.Lock()
        scans = self._folder.read_json(SCANS_FILE, list, _LIST_BYTES_AT_MOST)
        if len(scans) != self.spec.num_scans or not all(map(_is_named, scans)):
            raise DataError(f"{location}/{SCANS_FILE}, which is damaged", "the scans of the plan", "prepare again")
        with ThreadPoolExecutor(_OPENED_AT_ONCE) as pool:
            indices = list(pool.map(self._read_index, range(self.spec.num_shards)))
        for shard, (entries, left_out) in enumerate(indices):
            if not self.spec.is_shard(shard, entries, left_out):
                raise DataError(f"{shard_name(shard)} with other scans", "those of the plan", "prepare again")
            self._entries += [(shard, entry) for entry in entries]
            self.left_out |= left_out
        # What some scans lack, none has: a batch has it of all of its images or of none, whichever they are.
        self._has_reflectance = all(entry.reflectance_bytes for _, entry in self._entries)
        self._has_labels = all(entry.label_bytes for _, entry in self._entries)
        self.provenance = Provenance(
            tuple(scans[entry.scan][0] for _, entry in self._entries),
            tuple(scans[entry.scan][1] for _, entry in self._entries),
            tuple(entry.fingerprint for _, entry in self._entries),
            tuple(entry.range_fingerprint for _, entry in self._entries),
        )

    def __len__(self) -> int:
        return len(self._entries)

    def remarks(self) -> list[str]:
        """Tell for a person which scans were left out, and what is read of none since some lack it."""
        told = [f"left out: {why}" for why in self.left_out.values()]
        for what, has in (("reflectance", "reflectance_bytes"), ("labels", "label_bytes")):
            lacking = [at for at, (_, entry) in enumerate(self._entries) if not getattr(entry, has)]
            if 0 < len(lacking) < len(self):
                which = f"{len(lacking)} of {len(self)} scans, such as {self.provenance.names[lacking[0]]}"
                told.append(f"WARNING: no {what} in {which}, so that no scan is read with {what}")
        return told + [f"WARNING: {doubt}" for doubt in self.doubts()]

    def doubts(self) -> tuple[str, ...]:
        """Return a sentence if the reflectance of some scans was divided by another number than that of others."""
        scales = Counter(entry.full_scale for _, entry in self._entries if entry.full_scale)
        if len(scales) < 2:
            return ()
        rare = min(scales, key=scales.__getitem__)
        at = next(at for at, (_, entry) in enumerate(self._entries) if entry.full_scale == rare)
        divided = " and ".join(f"by {scale:,} in {counted_scans(count)}" for scale, count in scales.most_common())
        return (
            f"reflectance divided {divided}, such as {self.provenance.names[at]}, as the largest value of each scan "
            "allowed: bright in one is dark in another; write it as numbers from 0 to 1",
        )

    def evenly_spaced(self, count: int) -> "PreparedImages":
        """Return so many of the images, evenly spaced, without opening the folder again."""
        chosen, whole, indices = copy.copy(self), self.provenance, evenly_spaced(count, len(self))
        chosen._entries = [self._entries[index] for index in indices]
        chosen.provenance = Provenance(
            *(
                tuple(of[index] for index in indices)
                for of in (whole.names, whole.recordings, whole.fingerprints, whole.range_fingerprints)
            )
        )
        return chosen

    def on_rays_of(self, sensor: SensorModel, variant: str) -> ImageStore:
        """Return the images with all fine columns of a sensor, which may be fewer than were prepared.

        Args:
            variant: projection variant that is wanted. The reference's columns cannot be gathered into fewer: it rounds
                points to the nearest column.
        """
        location, prepared, wanted = self._folder.location, self.sensor, sensor.fine()
        is_wider = variant == "exact" and has_fewer_columns(wanted, prepared)
        if not (is_wider or prepared.same_rays(wanted)):
            raise DataError(
                f"{location}, prepared for {prepared.name!r} ({prepared.height}x{prepared.width})",
                f"the rays of {sensor.name!r} ({wanted.height}x{wanted.width} with every fine column)",
                "name the sensor that it was prepared for, or prepare it for this one",
            )
        theirs = (self.spec.variant, prepared.projection, prepared.range_min_m, prepared.range_max_m)
        ours = (variant, wanted.projection, wanted.range_min_m, wanted.range_max_m)
        if theirs != ours:
            projections = [
                f"{variant}, {projection}, {near:g} to {far:g} m" for variant, projection, near, far in (theirs, ours)
            ]
            raise DataError(
                f"{location}, prepared by the projection {projections[0]}",
                projections[1],
                "choose it (--projection, --set data.projection_variant), or prepare anew",
            )
        return FewerColumns(self, prepared.width, wanted.width) if is_wider else self

    def read(self, index: int, verify: bool = False) -> Pixels:
        """Return the pixels of one image, without reflectance or labels if any image of the folder lacks them.

        Args:
            index: number of the image.
            verify: whether to compare the pixels with their fingerprint.
        """
        shard, entry = self._entries[index]
        name = f"{self._folder.location}/{shard_name(shard)}"
        pixels = read_image(self._bytes(shard), entry, self._shape, self.spec.range_step_m, name, verify)
        kept = {"reflectance": self._has_reflectance, "label": self._has_labels}
        return Pixels(pixels.range_m, {name: plane for name, plane in pixels.planes.items() if kept[name]})

    def shard_of(self, index: int) -> int:
        """Return the number of the shard that holds an image."""
        return self._entries[index][0]

    def _read_index(self, shard: int) -> tuple[list[ShardEntry], dict[int, str]]:
        return read_index(self._bytes(shard), shard_name(shard))

    def _bytes(self, shard: int) -> Bytes:
        with self._lock:
            if shard in self._open:
                return self._open[shard]
        file = self._folder.open(shard_name(shard))  # not under the lock: a store takes a while to answer
        with self._lock:
            return self._open.setdefault(shard, file)
