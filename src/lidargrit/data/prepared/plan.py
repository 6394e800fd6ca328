"""What a prepared folder is to hold, and what is known of each image beside its pixels; kept as JSON."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from lidargrit.core.configuration import hints_of, rebuilt

PLAN_FILE, SCANS_FILE, ARRAYS, MADE_FOLDER = "plan.json", "scans.json", "images.zarr", "made"
STORED_AS = {"range": "uint16", "reflectance": "uint8", "label": "uint16"}  # the arrays of a store
FORMAT = 5  # to be raised whenever projection or simulation give other pixels for the same scan


@dataclass(frozen=True)
class PreparedSpec:
    """Everything that the pixels of a prepared folder depend on; ``plan.json`` holds it under these names.

    Args:
        format: number of the format, raised whenever projection or simulation gives other pixels for the same scan.
        sensor: JSON of the sensor, with all its fine columns.
        variant: projection variant: ``exact``, ``reference`` or ``clamped``.
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

    @classmethod
    def from_json(cls, entries: dict[str, Any]) -> "PreparedSpec":
        """Return the plan that a file holds, or raise TypeError or ConfigError; the sensor checks itself."""
        names = hints_of(cls).keys()
        if wrong := sorted(names - entries.keys()) or sorted(entries.keys() - names):
            raise TypeError(f"it {'has' if wrong[0] in entries else 'lacks'} {', '.join(map(ascii, wrong[:3]))}")
        spec = rebuilt(cls, entries)
        if spec.format != FORMAT or min(spec.shard_scans, spec.num_scans) < 1:
            raise TypeError(f"format {spec.format}, {spec.num_scans} scans by {spec.shard_scans}")
        return spec

    @property
    def num_shards(self) -> int:
        """Number of shards."""
        return -(-self.num_scans // self.shard_scans)

    def scans_of(self, shard: int) -> range:
        """Return the indices of one shard's scans among all scans."""
        return range(shard * self.shard_scans, min((shard + 1) * self.shard_scans, self.num_scans))

    def differences(self, other: "PreparedSpec") -> list[str]:
        """Return the names of the fields that differ from another's."""
        mine, theirs = asdict(self), asdict(other)
        return [name for name in mine if mine[name] != theirs[name]]


@dataclass(frozen=True)
class ImageFacts:
    """What is known of one image beside its pixels.

    Args:
        scan: index of the image's scan among all scans of the prepared folder.
        fingerprint: hash of ranges and reflectance, as they are stored.
        range_fingerprint: hash of the ranges alone, by which a scan without its reflectance is recognised.
        label_fingerprint: hash of the classes; "" if there are none. A scan is the same with labels or without.
        full_scale: number that the reflectance of the scan's file was divided by because its largest value fits; 0 if
            that had not to tell.
    """

    scan: int
    fingerprint: str
    range_fingerprint: str
    label_fingerprint: str
    full_scale: int

    @property
    def has_reflectance(self) -> bool:
        """Whether reflectance is stored."""
        return self.fingerprint != self.range_fingerprint

    @property
    def has_labels(self) -> bool:
        """Whether classes are stored."""
        return bool(self.label_fingerprint)


@dataclass
class MadeScans:
    """Scans of a shard that were made or left out; a file of the folder holds them, and is written after their pixels.

    Args:
        images: facts of the images.
        left_out: reasons why scans cannot be used, by their indices.
        file_bytes: sizes of the shard's files by the names of their arrays; one that was cut short is recognised by it.
    """

    images: list[ImageFacts] = field(default_factory=list)
    left_out: dict[int, str] = field(default_factory=dict)
    file_bytes: dict[str, int] = field(default_factory=dict)

    @property
    def scans(self) -> list[int]:
        """Indices of the scans, sorted."""
        return sorted([*(image.scan for image in self.images), *self.left_out])

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "MadeScans":
        """Return what a file holds, or raise one of ValueError, KeyError, TypeError and AttributeError."""
        images = [ImageFacts(**entry) for entry in content["images"]]
        for image in images:
            if not all(type(number) is int and number >= 0 for number in (image.scan, image.full_scale)):
                raise ValueError("numbers that are not whole")
            hashes = image.fingerprint, image.range_fingerprint, image.label_fingerprint
            if not all(isinstance(one, str) for one in hashes):
                raise ValueError("a fingerprint that is none")
        left_out = {int(scan): str(why) for scan, why in content["left_out"].items()}
        return cls(images, left_out, {name: int(content["file_bytes"][name]) for name in content["file_bytes"]})


def made_name(shard: int) -> str:
    """Return the name of the file that tells which scans of a shard are made."""
    return f"{MADE_FOLDER}/{shard:06d}.json"


def pixels_name(plane: str, shard: int) -> str:
    """Return the name of the file that holds one shard of an array."""
    return f"{ARRAYS}/{plane}/c.{shard}.0.0"
