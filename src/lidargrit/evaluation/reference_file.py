"""What metrics keep of real scans ⇄ one file, by which others score their samples without these scans."""

import hashlib
import json
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lidargrit.core.arrays import open_archive, read_member
from lidargrit.core.configuration import rebuilt
from lidargrit.core.errors import ConfigError, DataError, LidarGritError, counted_scans, without_folders
from lidargrit.core.files import atomic_path, sha256_of_json
from lidargrit.core.untrusted import check_path, parse_json
from lidargrit.core.version import __version__
from lidargrit.data.formats import open_file
from lidargrit.data.images import Provenance, RangeImages
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources.source import Source
from lidargrit.evaluation.intervals import Part, Resampling, blocks
from lidargrit.evaluation.metrics import load_metric
from lidargrit.evaluation.pairs import EvalPair, EvalSet, Opened, paired
from lidargrit.evaluation.protocols import Protocol
from lidargrit.evaluation.scorecard import EvalSetRecord, by_reason
from lidargrit.evaluation.scoring import KeptOfReal, MetricFactory
from lidargrit.scans.sensors import SensorModel

ENDING = ".lgref"
METRIC_BYTES_AT_MOST = 192 << 20
"""Bytes that a metric may keep unless a user names it: 10,000 scans take 145 MB in moments, 5,000 750 in patches."""
_ABOUT = "about.npy"  # JSON as an array of bytes: the file is an .npz
_WANTED = "a reference file of this version"
_CURE = "get it again, or make one with: lidargrit evaluate DATA --save-reference FILE"


@dataclass(frozen=True)
class KeptPart:
    """What a metric keeps of one group of scans: its arrays, each by the hash of its numbers."""

    num_scans: int
    arrays: dict[str, str]


@dataclass(frozen=True)
class KeptMetric:
    """What a metric keeps of the reference, group by group: see :class:`.KeptOfReal`.

    Args:
        weights_sha256: hash of the weights that it looked through; "" without any.
        why_not: reason why it kept nothing; "" if it did.
    """

    metric: str
    variant: str
    why_not: str = ""
    weights_sha256: str = ""
    real: tuple[KeptPart, ...] = ()
    as_generated: tuple[KeptPart, ...] = ()
    pixel_statistics: tuple[KeptPart, ...] = ()


@dataclass(frozen=True)
class Contents:
    """What a reference file says of itself.

    Args:
        protocol_sha256: hash of the protocol by which it was made.
        groups: number of groups of scans for intervals; 0 for none.
        set: entry of the reference in a score file.
        full_rows: first row of those that always return, and the one behind the last; none where rays may drop.
        recordings, fingerprints, range_fingerprints: provenance of the scans, without names of files.
    """

    protocol: str
    protocol_sha256: str
    version: str
    seed: int
    groups: int
    with_pixel_statistics: bool
    set: EvalSetRecord
    projection_variant: str
    full_rows: tuple[int, ...]
    doubts: tuple[str, ...]
    recordings: tuple[str, ...]
    fingerprints: tuple[str, ...]
    range_fingerprints: tuple[str, ...]
    metrics: tuple[KeptMetric, ...]


class ReferenceFile:
    """A file that :func:`write_reference` wrote; arrays are read, and their hashes checked, when they are asked for."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with self._archive() as archive:
            data = self._array(archive, _ABOUT).tobytes()
        about = parse_json(data, str(path), dict, DataError, _WANTED, _CURE)
        self.sha256 = str(about.pop("sha256", ""))
        if self.sha256 != sha256_of_json(about):
            raise DataError(f"{path}, which was altered after it was written", _WANTED, _CURE)
        try:
            self.sensor = SensorModel.from_json(about.pop("sensor"))
            self.contents: Contents = rebuilt(Contents, about)
            if len(self.contents.full_rows) not in (0, 2):
                raise TypeError(f"full_rows of {len(self.contents.full_rows)} numbers")
        except (KeyError, TypeError, ConfigError) as error:
            reason = error.got if isinstance(error, ConfigError) else error
            raise DataError(f"{path}, which cannot be used ({reason})", _WANTED, _CURE) from None

    def pair_with(self, samples: Source, protocol: Protocol, config: DataConfig) -> EvalPair:
        """Return samples and what is kept of the reference as the two sets of an evaluation."""
        kept, count = self.contents, self.contents.set.scans_used
        at_most = protocol.scans_at_most(config.max_scans)
        if 0 < at_most < count:
            wanted, cure = f"all {count:,}", "leave -n out, or make a reference file of fewer"
            got = f"-n {at_most} with {self.path}, which sums up {counted_scans(count)}"
            raise ConfigError(got, wanted, cure)
        config = replace(config, max_scans=at_most, projection_variant=kept.projection_variant or "exact")
        samples = samples.cut(protocol.first_points) if protocol.first_points else samples
        first = Opened.of(samples, self.sensor, config)
        if not (sensor := first.images.sensor).same_rays(self.sensor):
            ours, theirs = (
                f"{each.name} ({each.height}x{each.width}, column stride {each.column_stride})"
                for each in (sensor, self.sensor)
            )
            got = f"range images of {ours}, and {self.path} of scans as {theirs} sees them"
            cure = "have a file made with --sensor and --set data.columns data.column_stride of these"
            raise ConfigError(got, "the same rays", cure)
        if len(first.images) < count:
            got = f"{counted_scans(len(first.images))} in {samples.text}, and a reference file of {count:,}"
            raise ConfigError(got, f"{count:,} samples or more", "sample more, or make a reference file with -n")
        provenance = Provenance((), kept.recordings, kept.fingerprints, kept.range_fingerprints)
        return paired(first, FiledSet.of(self), protocol, provenance, kept.doubts)

    def require(self, protocol: str, protocol_sha256: str, resampling: Resampling, seed: int, pixels: bool) -> None:
        """Refuse settings of an evaluation other than those that the file was made with, with ConfigError."""
        kept = self.contents
        given = {"--protocol": protocol, "--seed": seed}
        own = {"--protocol": kept.protocol, "--seed": kept.seed}
        if resampling.halves:
            given["--groups"], own["--groups"] = resampling.groups, kept.groups
        for option, value in given.items():
            if value != own[option]:
                got = f"{option} {value} with {self.path}, which was made with {own[option]}"
                cure = "leave out intervals: --intervals 0" if own[option] == 0 else f"{option} {own[option]}"
                raise ConfigError(got, "the same", cure)
        if protocol_sha256 != kept.protocol_sha256:
            got = f"{self.path}, made by lidargrit {kept.version}, in which the protocol {protocol} was another"
            raise ConfigError(got, "that of this version", "make it again: lidargrit evaluate DATA --save-reference")
        if pixels and not kept.with_pixel_statistics:
            got = f"--pixel-statistics with {self.path}, which holds none"
            raise ConfigError(got, "a file made with --pixel-statistics", "leave the option out")

    def facts(self) -> dict[str, Any]:
        """Return what the file holds, as plain values."""
        kept = self.contents
        return {
            "file": str(self.path),
            "bytes": self.path.stat().st_size,
            "sha256": self.sha256,
            "protocol": kept.protocol,
            "reference": asdict(kept.set),
            "metrics": [
                {name: getattr(each, name) for name in ("metric", "variant", "why_not")} for each in kept.metrics
            ],
        }

    def as_text(self) -> str:
        """Return what the file holds as lines for a person."""
        kept = self.contents
        named = {f"{each.metric} ({each.variant})": each.why_not for each in kept.metrics}
        lines = [
            f"{self.path}: {self.path.stat().st_size / 1e6:.1f} MB, sums over {counted_scans(kept.set.scans_used)} of "
            f"{kept.set.source}, which it does not hold; protocol {kept.protocol}; sha256 {self.sha256}",
            f"holds: {', '.join(name for name, why_not in named.items() if not why_not)}",
            *by_reason(("not held", name, why_not) for name, why_not in named.items() if why_not),
            f"score with: lidargrit evaluate SAMPLES {self.path} --protocol {kept.protocol}",
        ]
        return "\n".join(lines)

    def kept(self, factory: MetricFactory) -> KeptOfReal | LidarGritError:
        """Return what a metric keeps of the reference; an error if that is not in the file."""
        try:
            metric = factory()
            found = [
                each for each in self.contents.metrics if (each.metric, each.variant) == (metric.name, metric.variant)
            ]
            if not found or found[0].why_not:
                why = found[0].why_not if found else "it was made without this metric"
                got = f"{self.path}, which holds nothing for {metric.name} ({metric.variant}): {why}"
                return DataError(got, "what it keeps of real scans", "score against these, or have a file made with it")
            expected = [len(group) for group in blocks(self.contents.set.scans_used, self.contents.groups or 1)]
            if [part.num_scans for part in found[0].real] != expected:
                raise DataError(f"{self.path}, which sums up other groups of scans", _WANTED, _CURE)
            with self._archive() as archive:
                sides = ((found[0].real, True), (found[0].as_generated, False), (found[0].pixel_statistics, False))
                parts = [
                    [self._part(archive, factory, part, found[0].weights_sha256, real) for part in some]
                    for some, real in sides
                ]
        except LidarGritError as error:
            return error
        return KeptOfReal(*parts)

    def _part(
        self, archive: zipfile.ZipFile, factory: MetricFactory, part: KeptPart, weights_sha256: str, real: bool
    ) -> Part:
        metric = factory()
        arrays = {name: self._array(archive, f"{sha256}.npy") for name, sha256 in part.arrays.items()}
        if wrong := [name for name, array in arrays.items() if _sha256_of_array(array) != part.arrays[name]]:
            raise DataError(f"{self.path}, in which {wrong[0]} of {metric.name} was altered", _WANTED, _CURE)
        try:
            metric.restore(arrays, self.sensor, part.num_scans, weights_sha256, real=real)
        except (KeyError, TypeError, ValueError) as error:
            got = f"{self.path}, in which an array of {metric.name} is missing or of another shape ({error})"
            raise DataError(got, _WANTED, _CURE) from None
        return Part(metric)

    @contextmanager
    def _archive(self) -> Iterator[zipfile.ZipFile]:
        with open_file(self.path, _WANTED) as file:
            try:
                archive = open_archive(file)
            except ValueError as error:
                raise DataError(f"{self.path}, which cannot be read ({error})", _WANTED, _CURE) from None
            with archive:
                yield archive

    def _array(self, archive: zipfile.ZipFile, name: str) -> np.ndarray:
        try:
            return read_member(archive, archive.getinfo(name))
        except (KeyError, ValueError) as error:
            raise DataError(f"{self.path}, which cannot be used ({error})", _WANTED, _CURE) from None


@dataclass(frozen=True, eq=False)
class FiledSet(EvalSet):
    """A reference of which only what metrics keep is here, and no scan."""

    file: ReferenceFile | None = None

    @classmethod
    def of(cls, file: ReferenceFile) -> "FiledSet":
        """Return the set that a file stands in for."""
        kept, record = file.contents, file.contents.set
        return cls(
            record.source,
            RangeImages(file.sensor, []),
            range(record.scans_used),
            data_set=record.data_set,
            split=record.split,
            projection_variant=kept.projection_variant,
            full_rows=range(*kept.full_rows) if kept.full_rows else None,
            file=file,
        )

    def record(self) -> EvalSetRecord:
        """Return the entry that the scans themselves would have, and the hash of the file."""
        assert self.file is not None
        return replace(self.file.contents.set, file_sha256=self.file.sha256)


def reference_file(text: str) -> ReferenceFile | None:
    """Open a reference file by its name; None for a name of something else."""
    return ReferenceFile(check_path(text)) if text.lower().endswith(ENDING) else None


def write_reference(
    path: Path,
    protocol: tuple[str, str],
    reference: Opened,
    scans: EvalSet,
    kept: Sequence[tuple[MetricFactory, KeptOfReal | LidarGritError]],
    resampling: Resampling,
    keep_all: bool,
) -> ReferenceFile:
    """Write what metrics keep of a reference into a file, atomically, and return it.

    Args:
        protocol: pair of name and hash of the protocol.
        scans: the scans of the reference that the metrics have seen.
        kept: pairs of a metric and its state after the scans, or an error.
        keep_all: whether metrics are kept that need more than :data:`METRIC_BYTES_AT_MOST`.
    """
    arrays: dict[str, np.ndarray] = {}
    metrics = [_filed(factory, each, arrays, keep_all) for factory, each in kept]
    source, provenance = reference.source, reference.images.provenance
    if all(each.why_not for each in metrics):
        got = f"{source.text}, of which {path} would hold nothing: {metrics[0].metric}: {metrics[0].why_not}"
        raise DataError(got, "one metric at least", "name the metrics by --metrics, or take fewer scans by -n")
    contents = Contents(
        *protocol,
        __version__,
        kept[0][0].seed,
        resampling.groups if resampling.halves else 0,
        any(each.pixel_statistics for each in metrics),
        replace(scans.record(), source=without_folders(source.text, [source.text])),
        reference.projection_variant,
        () if source.full_rows is None else (source.full_rows.start, source.full_rows.stop),
        reference.doubts,
        tuple(sorted({*provenance.recordings} - {""})),
        provenance.fingerprints,
        provenance.range_fingerprints,
        tuple(metrics),
    )
    about = {**asdict(contents), "sensor": scans.images.sensor.to_json()}
    about = json.loads(json.dumps(about))
    about["sha256"] = sha256_of_json(about)
    arrays["about"] = np.frombuffer(json.dumps(about).encode(), np.uint8)
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, array in arrays.items():
            info = zipfile.ZipInfo(f"{name}.npy")
            info.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(info, "w", force_zip64=True) as file:
                np.lib.format.write_array(file, array, allow_pickle=False)
    return ReferenceFile(path)


def _filed(
    factory: MetricFactory, kept: KeptOfReal | LidarGritError, arrays: dict[str, np.ndarray], keep_all: bool
) -> KeptMetric:
    """Return the entry of a metric, whose arrays are added by their hashes: what is the same is kept once."""
    cls = load_metric(factory.choice.metric)
    names = factory.choice.metric, factory.choice.variant or cls.variants[0]
    if isinstance(kept, LidarGritError):
        return KeptMetric(*names, why_not=f"{kept.got}; it wants {kept.wanted}")
    new: dict[str, np.ndarray] = {}

    def filed(parts: Sequence[Part], real: bool) -> tuple[KeptPart, ...]:
        found = []
        for metric in (part.metric() for part in parts):
            state = metric.state(real=real)
            hashes = {name: _sha256_of_array(array) for name, array in state.items()}
            new.update((hashes[name], array) for name, array in state.items())
            found.append(KeptPart(metric.num_images[real], hashes))
        return tuple(found)

    sides = filed(kept.real, True), filed(kept.as_generated, False), filed(kept.pixel_statistics, False)
    size = sum(array.nbytes for array in new.values())
    if size > METRIC_BYTES_AT_MOST and not keep_all:
        why = f"it would take {size >> 20} MB, more than {METRIC_BYTES_AT_MOST >> 20} (--metrics {names[0]} keeps all)"
        return KeptMetric(*names, why_not=why)
    arrays |= new
    return KeptMetric(*names, "", kept.real[0].metric().weights_sha256, *sides)


def _sha256_of_array(array: np.ndarray) -> str:
    """Return the first half of a hash of the numbers, the type and the shape of an array."""
    content = hashlib.sha256(f"{array.dtype.str} {array.shape} ".encode())
    content.update(array.tobytes())
    return content.hexdigest()[:32]
