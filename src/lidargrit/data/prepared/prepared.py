"""A prepared folder, on this machine or behind a URL → range images."""

import copy
from collections import Counter
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import ConfigError, DataError, counted_scans
from lidargrit.core.files import read_json
from lidargrit.core.untrusted import JSON_BYTES_AT_MOST, parse_json, user_path
from lidargrit.data.images import ImageStore, Pixels, Provenance, TimedStore
from lidargrit.data.prepared.arrays import ImageArrays, damaged, range_step_m, store_context, store_errors, store_of
from lidargrit.data.prepared.plan import (
    PLAN_FILE,
    SCANS_FILE,
    STORED_AS,
    MadeScans,
    PreparedSpec,
    made_name,
    pixels_name,
)
from lidargrit.scans.motion import Motion
from lidargrit.scans.sensors import SensorModel

_OPENED_AT_ONCE = 16  # files: a store takes some hundredths of a second for each
_LIST_BYTES_AT_MOST = 2**28  # the list of a million scans takes half of it
_WRITTEN, _AGAIN = "what lidargrit prepare wrote", "prepare it again"


class FewerColumns:
    """Images of a store whose columns are gathered into fewer: of each new pixel, the nearest return stays.

    Where the number of columns falls to a whole part, these are the pixels that a projection of the points gives, but
    that of two returns in one step of the stored ranges either may stay.
    Otherwise a return goes to the new column in which the centre of its old one lies, up to half an old column from
    where its point lay.

    Args:
        images: store of images that are ``columns`` wide.
        wanted: number of columns of the new images, at most as many.
    """

    def __init__(self, images: ImageStore, columns: int, wanted: int) -> None:
        self._images, self.provenance = images, images.provenance
        self.motions = images.motions if isinstance(images, TimedStore) else (Motion(),) * len(images)
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


def is_prepared(source: str) -> bool:
    """Return whether a source is where prepared scans lie: a URL, or a folder with a plan."""
    try:
        return "://" in source or (user_path(source) / PLAN_FILE).is_file()
    except (OSError, DataError):  # no file can be called so, or no home folder is there
        return False


class PreparedFolder:
    """The files of a prepared folder, on this machine or behind a URL.

    Args:
        location: path on this machine, or a URL of S3, Google Cloud Storage or HTTP, such as s3://bucket/scans.
    """

    def __init__(self, location: str) -> None:
        self._is_local = "://" not in location
        self.location = str(user_path(location)) if self._is_local else location.rstrip("/")
        self._store = store_of(self.location)

    def read_json(self, name: str, kind: type = dict, at_most: int = JSON_BYTES_AT_MOST) -> Any:
        """Read a whole JSON file of bounded size and depth.

        Args:
            kind: required type of the whole, dict or list.
            at_most: largest size, in bytes.
        """
        if self._is_local:
            return read_json(Path(self.location, name), kind, DataError, _WRITTEN, _AGAIN, at_most)
        import tensorstore  # noqa: PLC0415  quick start of commands that read no prepared scans

        location = f"{self.location}/{name}"
        with store_errors(location):
            found = tensorstore.KvStore.open(self._store, context=store_context(True)).result().read(name).result()
        if found.state != "value":
            raise DataError(f"{location}, which does not exist", _WRITTEN, "prepare it, or check the URL")
        return parse_json(found.value, location, kind, DataError, _WRITTEN, _AGAIN, at_most)

    def read_spec(self) -> PreparedSpec:
        """Read what the images were prepared from and how, or raise DataError."""
        entries = self.read_json(PLAN_FILE)
        try:
            return PreparedSpec.from_json(entries)
        except (TypeError, ConfigError) as error:
            reason = error.got if isinstance(error, ConfigError) else error
            got = f"{self.location}/{PLAN_FILE}, which is no plan ({reason})"
            raise DataError(got, "one of this version", "prepare into another folder") from None

    def read_made(self, shard: int) -> MadeScans:
        """Read which scans of a shard are made, or raise DataError."""
        content = self.read_json(made_name(shard))
        try:
            return MadeScans.from_json(content)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise damaged(f"{self.location}/{made_name(shard)}", str(error)) from None

    def kept(self, shard: int) -> MadeScans:
        """Return what is there of a shard on this machine; nothing where one of its files is lost or damaged."""
        try:
            made = self.read_made(shard)
            files = {name: Path(self.location, pixels_name(name, shard)) for name in STORED_AS}
            sizes = {name: file.stat().st_size for name, file in files.items() if file.is_file()}
        except (DataError, OSError):
            return MadeScans()
        return made if sizes == made.file_bytes else MadeScans()

    def missing(self, spec: PreparedSpec, shards: Iterable[int]) -> list[int]:
        """Return those of some shards that are not there as a whole on this machine."""
        return [shard for shard in shards if self.kept(shard).scans != list(spec.scans_of(shard))]


def _is_named(scan: Any) -> bool:
    """Return whether an entry of the list of scans begins with the scan's name and its recording."""
    return isinstance(scan, list) and len(scan) >= 2 and isinstance(scan[0], str) and isinstance(scan[1], str)


def _motion_of(scan: list[Any], path: str) -> Motion:
    """Return when and where a scan of the list was made: the time and the 16 numbers of the pose that may end it."""
    time_s, pose = scan[4:6] if len(scan) == 6 else (None, None)
    try:
        matrix = None if pose is None else torch.tensor(pose, dtype=torch.float64).view(4, 4)
        return Motion(None if time_s is None else float(time_s), matrix)
    except (TypeError, ValueError, RuntimeError):
        raise DataError(f"{path} with a time or pose that is none", "numbers", _AGAIN) from None


class PreparedImages:
    """The range images of a prepared folder.

    Args:
        location: path of the folder, or its URL.
    """

    def __init__(self, location: str) -> None:
        self._folder = PreparedFolder(location)
        self.spec = self._folder.read_spec()
        try:
            self.sensor = SensorModel.from_json(self.spec.sensor)
        except ConfigError as error:
            raise DataError(f"{location}/{PLAN_FILE}, in which stands {error.got}", error.wanted, _AGAIN) from None
        if self.spec.range_step_m != range_step_m(self.sensor):  # pixels are numbers of steps
            raise DataError(
                f"{location}/{PLAN_FILE}, whose range_step_m is another than its sensor's",
                f"{range_step_m(self.sensor):g} m",
                "prepare again",
            )
        scans = self._folder.read_json(SCANS_FILE, list, _LIST_BYTES_AT_MOST)
        if len(scans) != self.spec.num_scans or not all(map(_is_named, scans)):
            raise DataError(f"{location}/{SCANS_FILE}, which is damaged", "the scans of the plan", _AGAIN)
        with ThreadPoolExecutor(_OPENED_AT_ONCE) as pool:
            made = list(pool.map(self._folder.read_made, range(self.spec.num_shards)))
        for shard, here in enumerate(made):
            if here.scans != list(self.spec.scans_of(shard)):
                raise DataError(f"{location}/{made_name(shard)} with other scans", "those of the plan", _AGAIN)
        self._arrays = ImageArrays(self._folder.location, self.spec)
        self._images = [image for here in made for image in here.images]
        self.left_out = {scan: why for here in made for scan, why in here.left_out.items()}
        # What some scans lack, none has: a batch has it of all of its images or of none, whichever they are.
        self._planes = ("range",)
        if all(image.has_reflectance for image in self._images):
            self._planes += ("reflectance",)
        if all(image.has_labels for image in self._images):
            self._planes += ("label",)
        self.provenance = Provenance(
            tuple(scans[image.scan][0] for image in self._images),
            tuple(scans[image.scan][1] for image in self._images),
            tuple(image.fingerprint for image in self._images),
            tuple(image.range_fingerprint for image in self._images),
            tuple(image.label_fingerprint if "label" in self._planes else "" for image in self._images),
        )
        self.motions = tuple(_motion_of(scans[image.scan], f"{location}/{SCANS_FILE}") for image in self._images)

    def __len__(self) -> int:
        return len(self._images)

    def remarks(self) -> list[str]:
        """Tell for a person which scans were left out, and what is read of none since some lack it."""
        told = [f"left out: {why}" for why in self.left_out.values()]
        has = {"reflectance": [image.has_reflectance for image in self._images]}
        has["labels"] = [image.has_labels for image in self._images]
        for what, there in has.items():
            lacking = [at for at, is_there in enumerate(there) if not is_there]
            if 0 < len(lacking) < len(self):
                which = f"{len(lacking)} of {len(self)} scans, such as {self.provenance.names[lacking[0]]}"
                told.append(f"WARNING: no {what} in {which}, so that no scan is read with {what}")
        return told + [f"WARNING: {doubt}" for doubt in self.doubts()]

    def doubts(self) -> tuple[str, ...]:
        """Return a sentence if the reflectance of some scans was divided by another number than that of others."""
        scales = Counter(image.full_scale for image in self._images if image.full_scale)
        if len(scales) < 2:
            return ()
        rare = min(scales, key=scales.__getitem__)
        at = next(at for at, image in enumerate(self._images) if image.full_scale == rare)
        divided = " and ".join(f"by {scale:,} in {counted_scans(count)}" for scale, count in scales.most_common())
        return (
            f"reflectance divided {divided}, such as {self.provenance.names[at]}, as the largest value of each scan "
            "allowed: bright in one is dark in another; write it as numbers from 0 to 1",
        )

    def evenly_spaced(self, count: int) -> "PreparedImages":
        """Return so many of the images, evenly spaced, without opening the folder again."""
        chosen, indices = copy.copy(self), evenly_spaced(count, len(self))
        chosen._images = [self._images[index] for index in indices]
        chosen.motions = tuple(self.motions[index] for index in indices)
        whole = (getattr(self.provenance, of.name) for of in fields(Provenance))
        chosen.provenance = Provenance(*(tuple(of[index] for index in indices) for of in whole))
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
        return self._arrays.read(self._images[index], self._planes, verify)

    def shard_of(self, index: int) -> int:
        """Return the number of the shard that holds an image."""
        return self._images[index].scan // self.spec.shard_scans
