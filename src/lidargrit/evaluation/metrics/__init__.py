"""Two sets of range images → a number; one metric = one file, which knows no generator and no global random state."""

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar, final

import numpy as np
import torch

from lidargrit.core import discovery
from lidargrit.core.errors import ConfigError, DataError, nearest_names
from lidargrit.evaluation.metrics.shared.accumulators import Accumulator, Kept
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage

_CHUNK = 16  # images at a time: the points of 64x1024 pixels take 13 MB


Features = TypeVar("Features")


@dataclass(frozen=True)
class MetricResult:
    """The value of a metric, with what is needed to read it.

    Args:
        value: value of the metric, in its unit.
        higher_is_better: whether a larger value is better.
        num_generated: number of generated scans.
        num_reference: number of real scans.
        variant: name of the definition, such as ``exact`` or ``reference``.
        details: further numbers by name, such as the value at every level.
    """

    metric: str
    value: float
    higher_is_better: bool
    num_generated: int
    num_reference: int
    variant: str
    details: dict[str, Any] = field(default_factory=dict)

    @property
    def weights_sha256(self) -> str:
        """Hash of the weights of the network that the metric looked through; "" without one."""
        weights = self.details.get("weights")
        return str(weights.get("sha256", "")) if isinstance(weights, dict) else ""


class FeatureExtractor(ABC, Generic[Features]):
    """Turns a batch of range images into what one or several metrics summarise.

    Subclasses are frozen dataclasses: two that are equal give equal features, so metrics that are fed together share
    them (:func:`update_together`).
    """

    @abstractmethod
    def __call__(self, images: RangeImage) -> Features:
        """Return the features of a batch of images on the CPU."""


@dataclass(frozen=True)
class WholeImages(FeatureExtractor[RangeImage]):
    """Leaves images as they are, for metrics that share no features with others."""

    def __call__(self, images: RangeImage) -> RangeImage:
        """Return the images."""
        return images


class ImageKind(NamedTuple):
    """What range images must have in common to be compared."""

    height: int
    width: int
    range_min_m: float
    range_max_m: float

    @classmethod
    def of(cls, sensor: SensorModel) -> "ImageKind":
        """Return the kind of a sensor's images."""
        return cls(sensor.height, sensor.width, sensor.range_min_m, sensor.range_max_m)

    def __str__(self) -> str:
        return "{}x{} between {:g} and {:g} m".format(*self)


class Metric(ABC, Generic[Features, Kept]):
    """Compares a set of generated range images with a set of real ones, fed batch by batch.

    A subclass says what it looks at (:meth:`extractor`), what it keeps of a batch (:meth:`summarise`, collected by
    ``accumulator``) and how it compares what it has kept of two sets (:meth:`compare`). All else is done here. It takes
    keyword options only, all with defaults, ``variant`` and ``seed`` among them, and changes none of its inputs.
    Metrics can be pickled, so that the parts of several processes can be merged in one.

    Args:
        variant: the published definition to compute; the first of ``variants`` if not given.
        seed: seed of all random numbers of the metric.

    Raises:
        ConfigError: a variant that the metric does not have.
    """

    title: ClassVar[str]
    """One line for lists and reports."""
    higher_is_better: ClassVar[bool] = False
    """Direction of the value."""
    bounds: ClassVar[tuple[float, float]] = (0.0, math.inf)
    """Least and greatest value that the metric can have."""
    variants: ClassVar[tuple[str, ...]] = ("exact",)
    """The published definitions on offer, the default first."""
    of_equal_sets: ClassVar[Mapping[str, str]] = {}
    """Why equal sets do not score 0, for each variant by which they do not."""
    needs_weights: ClassVar[str] = ""
    """Name of the pretrained network whose features the metric compares; empty for most."""
    measures_raydrop: ClassVar[bool] = False
    """Whether the metric compares which rays return: it does not apply to a generator without raydrop."""
    sees_objects: ClassVar[bool] = False
    """Whether the metric looks at what stands in scans: a verdict names it before others."""
    fewest_images: ClassVar[int] = 2
    """Number of images that each set needs."""
    accumulator: type[Accumulator[Kept]]
    """Class of what collects the summaries of one set."""

    def __init__(self, *, variant: str | None = None, seed: int = 0) -> None:
        self.variant = self.variants[0] if variant is None else variant
        self.seed = seed
        if self.variant not in self.variants:
            raise ConfigError(
                f"variant {self.variant!r} of the metric {self.name!r}",
                " or ".join(map(repr, self.variants)),
                "choose one of these",
            )
        self.kind: ImageKind | None = None
        self.num_images = {False: 0, True: 0}
        self.first_image = 0
        """Place in the two sets of the first image that is fed here, for parts that are merged later.

        Sliced Wasserstein distances by the variant ``reference`` sample patch positions by an image's place.
        """
        self._kept = {real: self.accumulator() for real in (False, True)}

    @property
    def name(self) -> str:
        """The public name of the metric: that of its file."""
        return type(self).__module__.rpartition(".")[2]

    @property
    def weights_sha256(self) -> str:
        """Hash of the file of weights of the network that ``needs_weights`` names; empty without one."""
        return ""

    @abstractmethod
    def extractor(self, sensor: SensorModel) -> FeatureExtractor[Features]:
        """Return what turns images of a sensor into the features that :meth:`summarise` takes."""

    @abstractmethod
    def summarise(self, features: Features, *, real: bool) -> np.ndarray:
        """Return what is kept of a batch: one row per image or a sum over the images, as ``accumulator`` wants it."""

    @abstractmethod
    def compare(self, generated: Kept, real: Kept) -> tuple[float, dict[str, Any]]:
        """Return the value, and the details of the result, for what is kept of two sets."""

    @final
    def update(self, images: RangeImage, *, real: bool) -> None:
        """Take in a batch of images or a single one, in any order of the two sets.

        Args:
            images: range images of one sensor.
            real: whether they belong to the real set, not to the generated one.

        Raises:
            ConfigError: images of another size or other range limits than those before.
        """
        update_together([(self, real)], images)

    @final
    def add_features(self, features: Features, num_images: int, *, real: bool) -> None:
        """Take in the features of a batch, which :meth:`extractor` has found; called by :func:`update_together`."""
        self._kept[real].add(self.summarise(features, real=real))
        self.num_images[real] += num_images

    @final
    def compute(self) -> MetricResult:
        """Return the number for all images so far; may be called again after further updates.

        Raises:
            DataError: one of the sets has too few images.
        """
        counts = self.num_images[False], self.num_images[True]
        if min(counts) < self.fewest_images:
            raise DataError(
                "{} generated and {} real range images for {!r}".format(*counts, self.name),
                f"at least {self.fewest_images} of each",
                "sample more scans, or check the folder",
            )
        value, details = self.compare(self.kept(real=False), self.kept(real=True))
        return MetricResult(self.name, value, self.higher_is_better, *counts, self.variant, details)

    @final
    def merge(self, other: "Metric[Features, Kept]") -> None:
        """Take in what another process has kept, as if its images had been fed here after ours.

        Raises:
            ConfigError: the other was made with other options or fed with images of another kind.
        """
        if other.options() != self.options():
            cure = "make the metric with the same options in every process"
            raise ConfigError(f"to merge {other.options()}", self.options(), cure)
        if other.kind is None:
            return
        self.require_same_kind(other.kind)
        for real, kept in other._kept.items():
            self._kept[real].merge(kept)
            self.num_images[real] += other.num_images[real]

    @final
    def kept(self, *, real: bool) -> Kept:
        """Return what has been kept of one set."""
        return self._kept[real].value()

    @final
    def state(self, *, real: bool) -> dict[str, np.ndarray]:
        """Return all that has been kept of one set, of at least one image, as arrays by name: see :meth:`restore`."""
        return self._kept[real].arrays()

    @final
    def restore(
        self, state: Mapping[str, np.ndarray], sensor: SensorModel, num_images: int, weights_sha256: str, *, real: bool
    ) -> None:
        """Take what :meth:`state` returned for images of a sensor, as if they had been fed here.

        Args:
            num_images: number of these images.
            weights_sha256: hash of the weights by which it was made; "" without any.

        Raises:
            KeyError: an array is missing.
            DataError: it was made by other weights than are here.
        """
        self.require_same_kind(ImageKind.of(sensor))
        self.extractor(sensor)  # some know only now which weights these images need
        if self.weights_sha256 != weights_sha256:
            ours, theirs = (sha256[:8] or "none" for sha256 in (self.weights_sha256, weights_sha256))
            got = f"weights {ours} for {self.name}, and a reference that was made by {theirs}"
            raise DataError(got, "the same weights", f"name these by --weights {self.needs_weights}=...")
        self._kept[real].restore(state)
        self.num_images[real] = num_images

    def choose_as(self, whole: "Metric[Features, Kept]") -> None:
        """Make the choices that depend on the size of the sets, if any, as a metric of larger ones makes them.

        A score of half of the scans then is of the same statistic as that of all.
        """

    def options(self) -> str:
        """Return what metrics must have in common to be merged, in words."""
        return f"{self.name} (variant {self.variant!r}, seed {self.seed})"

    @final
    def require_same_kind(self, kind: ImageKind) -> None:
        """Refuse images of another size or other range limits than those before."""
        first = self.kind or kind
        if kind != first:
            raise ConfigError(
                f"range images of {kind}", f"{first}, as the images before", "project both sets with one sensor"
            )
        self.kind = first


class ImageMetric(Metric[RangeImage, np.ndarray]):
    """A metric that summarises range images themselves and shares no features with others."""

    @final
    def extractor(self, sensor: SensorModel) -> WholeImages:
        """Return what leaves images as they are."""
        return WholeImages()


@torch.no_grad()
def update_together(metrics: Sequence[tuple[Metric[Any, Any], bool]], images: RangeImage) -> None:
    """Feed a batch of images to several metrics, and compute features that several of them need only once.

    Args:
        metrics: metrics, each with whether the images belong to its real set.

    Example:
        >>> from lidargrit.evaluation.metrics import BevJsd, BevMmd
        >>> from lidargrit import load_sensor, simulate
        >>> from lidargrit.scans.projection import project
        >>> sensor = load_sensor("hdl64e_kitti_360").with_columns(64)
        >>> jsd, mmd = BevJsd(), BevMmd()
        >>> update_together([(jsd, True), (mmd, True)], project(simulate(seed=0, sensor=sensor), sensor))
        >>> jsd.num_images
        {False: 0, True: 1}
    """
    for metric, _ in metrics:
        metric.require_same_kind(ImageKind.of(images.sensor))
    images = images.to("cpu")
    batch = images if images.range_m.ndim == 3 else RangeImage.stack([images])
    for first in range(0, len(batch), _CHUNK):
        chunk = batch[first : first + _CHUNK]
        features: dict[FeatureExtractor[Any], Any] = {}
        for metric, real in metrics:
            extractor = metric.extractor(chunk.sensor)
            if extractor not in features:
                features[extractor] = extractor(chunk)
            metric.add_features(features[extractor], len(chunk), real=real)


def __getattr__(name: str) -> type[Metric]:
    """Find the class SlicedWasserstein, when it is asked for, in ``sliced_wasserstein.py``."""
    file = re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()
    if not name[:1].isupper() or file not in discovery.names("metrics"):
        meant = "".join(word.title() for word in nearest_names(file, discovery.names("metrics"), 1).split("_"))
        hint = f"; did you mean {meant}?" if name[:1].isupper() else ""
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint}")
    return load_metric(file)


def load_metric(name: str) -> type[Metric]:
    """Return the class of a metric by its name.

    Raises:
        UnknownNameError: no metric of that name; names its nearest neighbours.

    Example:
        >>> load_metric("sliced_wasserstein").higher_is_better
        False
    """
    return discovery.load_class("metrics", name, Metric)
