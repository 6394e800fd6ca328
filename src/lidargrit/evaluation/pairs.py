"""The two sets of an evaluation: sources → range images, which of them are compared, and what is known of them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from lidargrit.datasets import open_dataset
from lidargrit.determinism import evenly_spaced
from lidargrit.errors import ConfigError, LidarGritError
from lidargrit.evaluation.protocols import Protocol
from lidargrit.evaluation.scorecard import SetFacts
from lidargrit.loading import DataConfig, PreparedImages, RangeImages, is_prepared
from lidargrit.reporting import Reporter
from lidargrit.sources import open_images, overlap
from lidargrit.sources.sample_formats import is_tensor_folder, load_sample_format, recognise
from lidargrit.sources.samples import is_sample_folder, projection_of
from lidargrit.structures import RangeImage

_BATCH = 16


@dataclass(frozen=True, eq=False)
class EvalSet:
    """One set of range images.

    Args:
        source: as the user named it.
        images: all of them.
        indices: of those that are compared.
        range_m: returns that are not strictly between these are none; None for all.
        data_set: which data set they are of; "samples" for generated ones, "" where that is not known.
        split: which part of it.
        variant: of the projection; "" where that is not known.
    """

    source: str
    images: RangeImages
    indices: Sequence[int]
    range_m: tuple[float, float] | None = None
    data_set: str = ""
    split: str = ""
    variant: str = ""

    def __len__(self) -> int:
        return len(self.indices)

    def batch(self, places: Sequence[int]) -> RangeImage:
        """Return the images at these places among those that are compared."""
        images = self.images.batch([self.indices[place] for place in places])
        if self.range_m is None:
            return images
        near, far = self.range_m
        mask = (images.range_m > near) & (images.range_m < far)
        reflectance = images.reflectance
        kept = RangeImage.masked(images.range_m, mask, images.sensor)
        return kept if reflectance is None else replace(kept, reflectance=torch.where(mask, reflectance, 0))

    def facts(self) -> SetFacts:
        """Return what the scorecard tells of the set, with the hash of what was compared."""
        sensor = self.images.sensor
        return SetFacts(
            self.source,
            self.data_set,
            self.split,
            len(self.images),
            len(self),
            f"{sensor.name} {sensor.height}x{sensor.width}",
            f"{sensor.projection}, {self.variant or 'variant not known'}",
            self._sha256(),
        )

    def _sha256(self) -> str:
        content = hashlib.sha256()
        known = self.images.provenance.fingerprints
        if len(known) == len(self.images):  # of the images with all fine columns: of which some were compared
            sensor = self.images.sensor
            content.update(f"{sensor.height}x{sensor.width} {sensor.projection} {self.variant} ".encode())
            for index in self.indices:
                content.update(known[index].encode())
        else:
            for first in range(0, len(self), _BATCH):
                batch = self.images.batch(self.indices[first : first + _BATCH])
                content.update(batch.range_m.contiguous().numpy().data)
        return content.hexdigest()


@dataclass(frozen=True, eq=False)
class EvalPair:
    """Samples and what they are compared with, equally many of both, and what there is to say against it.

    Args:
        samples: the first set.
        reference: the second.
        deviations: how the two differ from what the protocol wants.
        warnings: why their scores may flatter, or say something else than one thinks.
    """

    samples: EvalSet
    reference: EvalSet
    deviations: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def pair_for_protocol(
    samples: str,
    reference: str,
    protocol: Protocol,
    config: DataConfig,
    samples_format: str = "",
    reporter: Reporter | None = None,
) -> EvalPair:
    """Open two sets as a protocol wants them.

    Args:
        samples: a folder of samples of ours or in a known sample_format, or a source of scans.
        reference: likewise; scans are projected with the sensor of the samples.
        protocol: which sensor, window, data set and number of scans are wanted.
        config: how scans are read and projected; ``max_scans`` further limits how many.
        samples_format: the sample_format of a folder of tensors; recognised if empty.
        reporter: hears of the projection.

    Raises:
        ConfigError: the two sets look along different rays.
    """
    reporter = reporter or Reporter()
    at_most = min((n for n in (config.max_scans, protocol.num_scans) if n), default=0)
    config = replace(config, max_scans=at_most)
    first = open_images(samples, protocol.load_sensor(), config, reporter, samples_format)
    second = open_images(reference, first.sensor, config, reporter)
    require_same_rays(first, second)
    count = min(len(first), len(second), at_most or len(first))
    both = [
        EvalSet(source, images, evenly_spaced(count, len(images)), protocol.range_m, *known_of(source, config, form))
        for source, images, form in ((samples, first, samples_format), (reference, second, ""))
    ]
    pair = EvalPair(both[0], both[1])
    return replace(pair, deviations=deviations(pair, protocol), warnings=warnings(pair))


def known_of(source: str, config: DataConfig, samples_format: str = "") -> tuple[str, str, str]:
    """Return of which data set a source is, which part of it, and by which variant its scans were projected."""
    folder = Path(source)
    if is_sample_folder(folder):
        return "samples", "", projection_of(folder)
    if samples_format or is_tensor_folder(folder):
        name = samples_format or recognise(folder)
        return "samples", name, load_sample_format(name).variant
    try:
        if is_prepared(source):
            spec = PreparedImages(source).spec
            return *known_of(spec.source, config)[:2], spec.variant
        dataset = open_dataset(source, config.bad_points)
    except LidarGritError:  # a prepared place outlives the scans that it was made of
        return "", "", ""
    return dataset.public_name(), dataset.split, config.projection_variant


def deviations(pair: EvalPair, protocol: Protocol) -> tuple[str, ...]:
    """Say in which ways two sets are not what a protocol wants."""
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
    if protocol.sensor and reference.variant not in {protocol.variant, ""}:
        found.append(f"the reference is projected by {reference.variant!r}, not by {protocol.variant!r}")
    return tuple(found)


def warnings(pair: EvalPair) -> tuple[str, ...]:
    """Say what flatters the scores of two sets, or makes them measure something else."""
    found = []
    first, second = pair.samples, pair.reference
    if shared := overlap(first.source, first.images, second.images):
        found.append(f"{first.source} and the reference overlap ({shared}): the scores flatter it")
    if first.variant and second.variant and first.variant != second.variant:
        found.append(
            f"the two sets took different roads: the samples' scans were projected by {first.variant!r}, those of the "
            f"reference by {second.variant!r}; scores mix this with what the model does"
        )
    return tuple(found)


def require_same_rays(generated: RangeImages, reference: RangeImages) -> None:
    """Refuse two sets that look along different rays, with ConfigError."""
    if not generated.sensor.same_rays(reference.sensor):
        raise ConfigError(
            f"range images of {generated.sensor.name!r} ({generated.sensor.height}x{generated.sensor.width})",
            f"the rays of {reference.sensor.name!r} ({reference.sensor.height}x{reference.sensor.width})",
            "project the scans with the samples' sensor: give the samples first, the scans second",
        )
