"""The two sets of an evaluation: sources → equally many range images of each, and warnings about the comparison."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import ConfigError
from lidargrit.core.files import sha256_of_json
from lidargrit.data.images import Provenance, RangeImages
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import Source, overlap
from lidargrit.evaluation.protocols import Protocol
from lidargrit.evaluation.scorecard import EvalSetRecord
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage

_BATCH = 16
_SAME_SHARE, _OF_A_GRID_AT_LEAST = 1e-3, 0.05  # distances that differ by less are one; share of points that have it
_POINTS_OF_A_GRID, _SAME_M, _GRID_M = 1000, 1e-3, 0.03  # voxels of generators are 10 to 20 cm wide


@dataclass(frozen=True, eq=False)
class EvalSet:
    """One set of range images that goes into the metrics.

    Args:
        range_m: nearest and farthest range of a return, in metres, both excluded; None for no limits.
        data_set: name of the data set; "samples" for generated images, "" where it is not known.
        projection_variant: variant by which scans became images; "" where it is not known.
        weights_sha256: hash of the weights that generated the images; "" where there are none, or it is not known.
        full_rows: rows in which every ray returns, with none in the others; None where rays may drop.
        streets: versions of the simulated streets that a model of the images learned from.
    """

    source: str
    images: RangeImages
    indices: Sequence[int]
    range_m: tuple[float, float] | None = None
    data_set: str = ""
    split: str = ""
    projection_variant: str = ""
    weights_sha256: str = ""
    full_rows: range | None = None
    streets: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.indices)

    def batch(self, indices: Sequence[int]) -> RangeImage:
        """Return some of the compared images, by their index among these, as one batch."""
        images = self.images.batch([self.indices[index] for index in indices])
        if self.range_m is None:
            return images
        near, far = self.range_m
        mask = (images.range_m > near) & (images.range_m < far)
        return RangeImage.masked(images.range_m, mask, images.sensor, images.planes)

    def record(self) -> EvalSetRecord:
        """Return the entry of the set in a score file; its hash is of the pixels before limits are applied."""
        sensor, labels = self.images.sensor, self.images.provenance.label_fingerprints
        compared = [labels[index] for index in self.indices] if len(labels) == len(self.images) else []
        return EvalSetRecord(
            self.source,
            self.data_set,
            self.split,
            len(self.images),
            len(self),
            f"{sensor.name} {sensor.height}x{sensor.width}",
            f"{sensor.projection}, {self.projection_variant or 'variant not known'}",
            self._sha256,
            self.weights_sha256,
            self.streets or self.images.provenance.streets,
            labels_sha256=sha256_of_json(compared) if any(compared) else "",
        )

    @cached_property
    def _sha256(self) -> str:
        """Hash of the compared pixels; it reads every image where a set has no fingerprints, so once."""
        content = hashlib.sha256()
        fingerprints = self.images.provenance.fingerprints
        if len(fingerprints) == len(self.images):  # of the images with all fine columns: of which some were compared
            sensor = self.images.sensor
            size = f"{sensor.height}x{sensor.width}, every {sensor.column_stride}th column"
            content.update(f"{size} {sensor.projection} {self.projection_variant} ".encode())
            for index in self.indices:
                content.update(fingerprints[index].encode())
        else:
            for first in range(0, len(self), _BATCH):
                batch = self.images.batch(self.indices[first : first + _BATCH])
                for pixels in (batch.range_m, *batch.planes.values()):
                    content.update(pixels.contiguous().numpy().data)
        return content.hexdigest()


@dataclass(frozen=True, eq=False)
class EvalPair:
    """Two sets of equally many images, and warnings about their comparison.

    Args:
        samples: first set, usually generated.
        reference: second set, usually real.
        deviations: differences from what the protocol wants, one sentence each.
        warnings: reasons why the scores may mislead, one sentence each.
        leak: sentence about scans of the reference that the model learned from, or that both sets hold; "" for none.
    """

    samples: EvalSet
    reference: EvalSet
    deviations: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    leak: str = ""

    def without_raydrop(self) -> str:
        """Return a sentence about the set without raydrop, to which metrics of raydrop do not apply; "" if none."""
        for each in (self.samples, self.reference):
            if (rows := each.full_rows) is not None:
                return (
                    f"{each.source} has no raydrop: its generator fills rows {rows.start} to {rows.stop - 1} of "
                    f"{each.images.sensor.height} with returns, and none of the others"
                )
        return ""


def pair_for_protocol(
    samples: Source, reference: Source, protocol: Protocol, config: DataConfig, sensor: SensorModel | None = None
) -> EvalPair:
    """Read two sets as a protocol wants them.

    Args:
        reference: source of the second set; scans are projected with the sensor of the first.
        protocol: definition of the sensor, range window, data set and number of scans that are wanted.
        config: settings of reading and projecting scans; ``max_scans`` further limits their number.
        sensor: sensor that scans are imaged with, in place of the protocol's; samples that are images keep theirs.
    """
    sensor = sensor or protocol.load_sensor()
    samples = samples.cut(protocol.first_points) if protocol.first_points else samples
    config = replace(config, max_scans=protocol.scans_at_most(config.max_scans))
    first = Opened.of(samples, sensor, config)
    if samples.has_points:  # whose points may have had to go by elevation: then so do the reference's
        config = replace(config, projection_variant=first.projection_variant)
    second = Opened.of(reference, first.images.sensor, config)
    if samples.has_points and second.images.sensor.projection != first.images.sensor.projection:
        config = replace(config, projection_variant=second.projection_variant)
        first = Opened.of(samples, second.images.sensor, config)
    count = min(len(first.images), len(second.images), config.max_scans or len(first.images))
    return paired(first, second.as_set(count, protocol.range_m), protocol, second.images.provenance, second.doubts)


def paired(
    first: "Opened", reference: EvalSet, protocol: Protocol, provenance: Provenance, doubts: tuple[str, ...]
) -> EvalPair:
    """Return the pair of opened samples and a reference, with all that is to be told of the two.

    Args:
        first: samples, at least as many as the reference has scans.
        provenance: provenance of the reference.
        doubts: reasons to doubt the reference.
    """
    samples = first.source
    require_same_rays(first.images.sensor, reference.images.sensor)
    pair = EvalPair(first.as_set(len(reference), protocol.range_m), reference)
    warnings = (*_warnings(pair), *first.doubts, *doubts)
    if len(drives := {*provenance.recordings} - {""}) == 1:
        one = f"all scans of {reference.source} are of one drive ({drives.pop()})"
        warnings = (*warnings, f"{one}: intervals tell of places along it, and nothing of other drives")
    if samples.has_points and (size_m := grid_of_points_m(samples.scans().scan(0).points_xyz_m)):
        voxels = f"the points of {samples.text} lie on a grid of {size_m:g} m: voxels, not returns of rays; "
        warnings = (*warnings, f"{voxels}scores of edges, walls, rows and raydrop measure the grid")
    shared = overlap(samples, first.images, provenance)
    leak = f"{samples.text} and the reference overlap ({shared}): the scores flatter it" if shared else ""
    if reference.data_set == "samples" != samples.data_set:
        swapped = f"{reference.source} was generated, and {samples.text} was not: the order is SAMPLES REFERENCE"
        warnings = (*warnings, swapped)
    return replace(pair, deviations=deviations(pair, protocol), warnings=warnings, leak=leak)


@dataclass(frozen=True, eq=False)
class Opened:
    """Images of a source, and what the source says of them; later it speaks of those that were opened last."""

    source: Source
    images: RangeImages
    projection_variant: str
    doubts: tuple[str, ...]

    @classmethod
    def of(cls, source: Source, sensor: SensorModel | None, config: DataConfig) -> "Opened":
        """Open the images of a source: see :meth:`.Source.images`."""
        images = source.images(sensor, config)
        return cls(source, images, source.projection_variant, source.doubts)

    def as_set(self, count: int, range_m: tuple[float, float] | None) -> EvalSet:
        """Return so many of the images, evenly spaced, as one set of an evaluation."""
        source, images = self.source, self.images
        return EvalSet(
            source.text,
            images,
            evenly_spaced(count, len(images)),
            range_m,
            source.data_set,
            source.split,
            self.projection_variant,
            source.weights_sha256,
            source.full_rows,
            (source.learned_from() or Provenance()).streets,
        )


def deviations(pair: EvalPair, protocol: Protocol) -> tuple[str, ...]:
    """Return the differences between two sets and what a protocol wants, one sentence each."""
    found = []
    reference, sensor, wanted = pair.reference, pair.samples.images.sensor, protocol.load_sensor()
    if protocol.num_scans and len(pair.samples) != protocol.num_scans:
        found.append(f"{len(pair.samples):,} of the {protocol.num_scans:,} scans of each set that it wants")
    if wanted is not None and not wanted.same_rays(sensor):
        found.append(
            f"images of {sensor.name} {sensor.height}x{sensor.width}, not of {wanted.name} "
            f"{wanted.height}x{wanted.width} with these rays"
        )
    if protocol.data_set and reference.data_set != protocol.data_set:
        found.append(f"the reference is {reference.data_set or 'of an unknown data set'}, not {protocol.data_set}")
    elif protocol.splits and reference.split not in protocol.splits:
        found.append(f"the reference is {reference.split!r} of {reference.data_set}, not {protocol.splits[0]!r}")
    for name, each in (("samples are", pair.samples), ("reference is", reference)):
        if wanted is not None:
            found += [f"the {name} {difference}" for difference in _other_images(each, wanted, protocol.variant)]
    return tuple(found)


def _other_images(images: EvalSet, wanted: SensorModel, variant: str) -> list[str]:
    """Return how a set became images in another way than a protocol wants, apart from their rays: ends of sentences."""
    found = []
    sensor = images.images.sensor
    if images.projection_variant not in {variant, ""}:
        found.append(f"projected by {images.projection_variant!r}, not by {variant!r}")
    if sensor.projection != wanted.projection:
        rows = {"spherical": "elevation (spherical)", "unfolding": "ring (unfolding)"}
        found.append(f"in rows by {rows[sensor.projection]}, not by {rows[wanted.projection]}")
    limits = [f"{each.range_min_m:g} to {each.range_max_m:g} m" for each in (sensor, wanted)]
    if limits[0] != limits[1]:
        found.append(f"of a sensor that sees {limits[0]}, not {limits[1]}")
    return found


def _warnings(pair: EvalPair) -> tuple[str, ...]:
    """Return reasons why the scores of two sets may mislead, one sentence each."""
    found = []
    first, second = pair.samples, pair.reference
    if without_raydrop := pair.without_raydrop():
        found.append(f"{without_raydrop}; metrics of pixels and points count the empty rows as missing")
    theirs, ours = first.projection_variant, second.projection_variant
    rows = [each.images.sensor.projection for each in (first, second)]
    if theirs and ours and (theirs != ours or rows[0] != rows[1]):
        if rows[0] != rows[1]:
            theirs, ours = (f"{variant} {row}" for variant, row in ((theirs, rows[0]), (ours, rows[1])))
        found.append(
            f"the projections differ: samples {theirs!r}, reference {ours!r}; the scores include this difference"
        )
    return tuple(found)


def require_same_rays(generated: SensorModel, reference: SensorModel) -> None:
    """Refuse two sets that look along different rays, with ConfigError."""
    if not generated.same_rays(reference):
        raise ConfigError(
            f"range images of {generated.name!r} ({generated.height}x{generated.width})",
            f"the rays of {reference.name!r} ({reference.height}x{reference.width})",
            "project the scans with the samples' sensor: give the samples first, the scans second",
        )


def grid_of_points_m(points_xyz_m: Float[Tensor, "n 3"]) -> float:
    """Return the spacing of the grid that points lie on, as corners or centres of voxels do; 0 for points of rays.

    It is the smallest distance of two coordinates along any axis that differ by more than a millimetre, if that is 3 cm
    or more; real clouds of a thousand points have neighbours of millimetres along each axis. In a grid that was turned,
    as OpenDWM's is from the car's frame into the sensor's, it is the smallest distance of two points, if many are as
    far from their nearest.
    """
    if len(points_xyz_m) < _POINTS_OF_A_GRID:
        return 0.0
    steps_m = [axis_m.unique().diff() for axis_m in points_xyz_m.double().T]
    smallest_m = min(float(steps[steps > _SAME_M].min()) if (steps > _SAME_M).any() else 0.0 for steps in steps_m)
    if smallest_m < _GRID_M:
        points = points_xyz_m.double().numpy()
        nearest_m = KDTree(points).query(points, k=2)[0][:, 1]
        smallest_m = float(nearest_m.min())
        smallest_m *= float((nearest_m < smallest_m * (1 + _SAME_SHARE)).mean() > _OF_A_GRID_AT_LEAST)
    return round(smallest_m, 3) if smallest_m >= _GRID_M else 0.0
