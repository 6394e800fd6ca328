"""Two sets and a list of metrics → scores with intervals and reference rows; shared features are computed once."""

import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import torch

from lidargrit.core import reporting
from lidargrit.core.determinism import scan_seed
from lidargrit.core.errors import ClusterError, DataError, LidarGritError, ScanError, first_words
from lidargrit.core.shares import each_done
from lidargrit.evaluation.intervals import Part, Resampling, Score, blocks, interval_of, merged, real_against_real
from lidargrit.evaluation.metrics import Metric, WholeImages, load_metric, update_together
from lidargrit.evaluation.pairs import EvalPair, EvalSet
from lidargrit.evaluation.protocols import MetricChoice
from lidargrit.scans.types import RangeImage

Found = TypeVar("Found")
_BATCH = 16
_PIXELS_AT_ONCE = 1 << 24  # shuffled in memory: 1,024 scans of 64x256


@dataclass(frozen=True)
class MetricFactory:
    """Makes empty metrics of one definition."""

    choice: MetricChoice
    seed: int = 0
    weights: Path | None = None
    device: str = "cpu"

    def __call__(self) -> Metric[Any, Any]:
        """Return an empty metric."""
        cls = load_metric(self.choice.metric)
        options: dict[str, Any] = {"variant": self.choice.variant or None, "seed": self.seed}
        if cls.needs_weights:
            options |= {"weights": self.weights, "device": self.device}
        return cls(**options)


@dataclass(frozen=True)
class Cluster:
    """A Ray cluster that feeds metrics, a group of scans a task.

    Args:
        ray: address of the cluster; see :func:`each_done`.
        open_pair: function that opens the two sets on one of its machines.
        on_gpus: whether a task takes a GPU.
    """

    ray: str
    open_pair: Callable[[], EvalPair]
    on_gpus: bool = False


@dataclass(eq=False)
class KeptOfReal:
    """What one metric keeps of the real scans: all that a score needs of them.

    Args:
        real: metrics that were fed one group of real scans each.
        as_generated: metrics that were fed the same scans as generated ones, for real against real.
        pixel_statistics: metrics that were fed pixel statistics as generated scans: of every second group of real scans
            from the first, and of the others. Empty if these are not wanted.
    """

    real: list[Part] = field(default_factory=list)
    as_generated: list[Part] = field(default_factory=list)
    pixel_statistics: list[Part] = field(default_factory=list)

    def score(
        self, generated: Sequence[Part], group_sizes: Sequence[int], resampling: Resampling, begun_s: float
    ) -> Score:
        """Compute the value with its interval, real against real and, where they were fed, pixel statistics.

        Args:
            generated: metrics that were fed one group of generated scans each.
        """
        metric = merged(generated, self.real)
        result = metric.compute()
        interval = reference_row = None
        if resampling.halves:
            interval = interval_of(result.value, metric, generated, self.real, resampling)
            reference_row = real_against_real(metric, self.real, self.as_generated, group_sizes, resampling)
        seconds = time.perf_counter() - begun_s
        return Score(result, interval, reference_row, seconds, self._score_of_pixel_statistics(metric))

    def _score_of_pixel_statistics(self, whole: Metric) -> float | None:
        """Return the mean score of pixel statistics of either half of the real scans against the other half."""
        values = []
        for half, shuffled in enumerate(self.pixel_statistics):
            try:
                values.append(merged([shuffled], self.real[1 - half :: 2], whole).compute().value)
            except DataError:  # half of the scans are too few for this metric
                return None
        return sum(values) / len(values) if values else None


def score_metrics(
    factories: Sequence[MetricFactory],
    pair: EvalPair,
    resampling: Resampling,
    with_pixel_statistics: bool = False,
    kept: Sequence[KeptOfReal | LidarGritError] = (),
    cluster: Cluster | None = None,
) -> list[Score | LidarGritError]:
    """Score two sets by several metrics.

    Metrics that look at the same features of a scan, such as those of one network, are fed together, so that these are
    computed once. All others are fed one after the other, so that only one's memory is held.

    Args:
        with_pixel_statistics: whether each score gets that of pixel statistics, if there are four scans or more.
        kept: state of each metric after the real scans, or an error, where these are not here themselves; else empty.
        cluster: cluster that feeds the metrics; not given, this process does.

    Returns:
        the score of each metric, or why it could not be computed: no weights, no reflectance, too few scans.
    """

    def scored(indices: list[int], advance: Callable[[int], None]) -> list[Score | LidarGritError]:
        begun_s = time.perf_counter()
        some = [factories[index] for index in indices]
        generated = _fed(some, pair.samples, False, resampling, advance, cluster)
        of_real = [each for index in indices if isinstance(each := kept[index], KeptOfReal)] if kept else []
        of_real = of_real or _keep_real(some, pair.reference, resampling, with_pixel_statistics, advance, cluster)
        feeding_s = (time.perf_counter() - begun_s) / len(some)
        sizes = [len(group) for group in _groups(pair.samples, resampling)]
        found: list[Score | LidarGritError] = []
        for factory, each, parts in zip(some, of_real, generated, strict=True):
            try:
                found.append(each.score(parts, sizes, resampling, time.perf_counter() - feeding_s))
            except LidarGritError as error:
                found.append(error)
            except (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError) as error:
                if not kept:
                    raise
                # A file may hold arrays of any shape and type, which metrics meet with errors of many kinds.
                got = f"a reference file with arrays that do not fit {factory.choice.metric} ({first_words(error)})"
                found.append(DataError(got, "the file as it was written", "get it again"))
        return found

    errors = {index: each for index, each in enumerate(kept) if isinstance(each, LidarGritError)}
    sets = 1 if kept else 3 if with_pixel_statistics else 2
    return _together(factories, pair.samples, sets, scored, errors)


def keep_real(
    factories: Sequence[MetricFactory], reference: EvalSet, resampling: Resampling, with_pixel_statistics: bool = False
) -> list[KeptOfReal | LidarGritError]:
    """Return what metrics keep of the real scans, or why one cannot: see :func:`score_metrics`."""

    def kept(indices: list[int], advance: Callable[[int], None]) -> list[KeptOfReal | LidarGritError]:
        some = [factories[index] for index in indices]
        return [*_keep_real(some, reference, resampling, with_pixel_statistics, advance)]

    return _together(factories, reference, 2 if with_pixel_statistics else 1, kept)


def _together(
    factories: Sequence[MetricFactory],
    images: EvalSet,
    sets: int,
    found_by: Callable[[list[int], Callable[[int], None]], list[Found | LidarGritError]],
    errors: Mapping[int, LidarGritError] = MappingProxyType({}),
) -> list[Found | LidarGritError]:
    """Return what is found by each metric, where those that share features are asked together.

    Args:
        sets: number of sets that are fed, for the progress.
        found_by: function of the numbers of metrics that share features, and of what tells the progress.
        errors: errors of metrics that are not asked, by their numbers.
    """
    found: dict[int, Found | LidarGritError] = {**errors}
    together: dict[Hashable, list[int]] = {}
    for index, factory in enumerate(factories):
        try:
            extractor = factory().extractor(images.images.sensor) if index not in errors else None
        except LidarGritError as error:
            found[index] = error
        else:
            if extractor is not None:
                together.setdefault(index if isinstance(extractor, WholeImages) else extractor, []).append(index)
    with reporting.progress("scoring", sets * len(images) * len(factories)) as progress:
        for indices in together.values():
            note = ", ".join(factories[index].choice.metric for index in indices)
            try:
                found |= zip(indices, found_by(indices, partial(progress.advance, note=note)), strict=True)
            except (ScanError, ClusterError):
                raise
            except LidarGritError as error:
                found |= dict.fromkeys(indices, error)
    return [found[index] for index in range(len(factories))]


def _groups(images: EvalSet, resampling: Resampling) -> list[range]:
    return blocks(len(images), resampling.groups if resampling.halves else 1)


def _fed(
    factories: Sequence[MetricFactory],
    images: EvalSet,
    real: bool,
    resampling: Resampling,
    advance: Callable[[int], None],
    cluster: Cluster | None,
) -> list[list[Part]]:
    """Feed a set to metrics that share features, group by group.

    Returns:
        the parts of each metric, and behind those of real scans, where there are intervals, the parts of each metric
        that were fed these as generated ones.
    """
    sides = [real, False] if real and resampling.halves else [real]
    groups = _groups(images, resampling)
    by_group: dict[range, list[Part]] = {}
    if cluster is None:
        for group in groups:
            by_group[group] = _feed(factories, images, sides, group, advance)
    else:
        do = partial(_feed_there, cluster.open_pair, factories, sides)
        for group, parts in each_done(do, groups, ray=cluster.ray, on_gpus=cluster.on_gpus):
            by_group[group] = parts
            advance(len(factories) * len(group))
    return [[by_group[group][number] for group in groups] for number in range(len(sides) * len(factories))]


def _feed(
    factories: Sequence[MetricFactory],
    images: EvalSet,
    sides: Sequence[bool],
    group: range,
    advance: Callable[[int], None],
) -> list[Part]:
    """Feed one group of a set to new metrics, for each side one of each factory."""
    metrics = [(factory(), side) for side in sides for factory in factories]
    for metric, _ in metrics:
        metric.first_image = group.start
    for first in range(0, len(group), _BATCH):
        batch = images.batch(group[first : first + _BATCH])
        update_together(metrics, batch)
        advance(len(factories) * len(batch))
    return [Part(metric) for metric, _ in metrics]


def _feed_there(
    open_pair: Callable[[], EvalPair], factories: Sequence[MetricFactory], sides: Sequence[bool], group: range
) -> tuple[range, list[Part]]:
    """Feed one group on a machine of a cluster; of the two sets it is the real one if the first side is."""
    pair = open_pair()
    return group, _feed(factories, pair.reference if sides[0] else pair.samples, sides, group, lambda _: None)


def _keep_real(
    factories: Sequence[MetricFactory],
    reference: EvalSet,
    resampling: Resampling,
    with_pixel_statistics: bool,
    advance: Callable[[int], None],
    cluster: Cluster | None = None,
) -> list[KeptOfReal]:
    count = len(factories)
    parts = _fed(factories, reference, True, resampling, advance, cluster)
    as_generated = parts[count:] or [[] for _ in factories]
    found = [KeptOfReal(*each) for each in zip(parts[:count], as_generated, strict=True)]
    if with_pixel_statistics:
        _feed_pixel_statistics(factories, found, reference, resampling, advance)
    return found


def _feed_pixel_statistics(
    factories: Sequence[MetricFactory],
    kept: Sequence[KeptOfReal],
    reference: EvalSet,
    resampling: Resampling,
    advance: Callable[[int], None],
) -> None:
    """Feed pixel statistics of every second group, then of the others, to metrics that share features."""
    groups = blocks(len(reference), resampling.groups)
    for half in range(2):
        indices = [index for group in groups[half::2] for index in group]
        if len(groups) < 2 or len(indices) < 2:  # one scan has nothing to be shuffled with
            return
        metrics = [factory() for factory in factories]
        for images in pixel_statistics(reference, indices, scan_seed(resampling.seed, 3, half)):
            for first in range(0, len(images), _BATCH):
                batch = images[first : first + _BATCH]
                update_together([(metric, False) for metric in metrics], batch)
                advance(len(metrics) * len(batch))
        for each, metric in zip(kept, metrics, strict=True):
            each.pixel_statistics.append(Part(metric))


def pixel_statistics(scans: EvalSet, indices: Sequence[int], seed: int) -> Iterator[RangeImage]:
    """Shuffle each pixel among scans, independently of all other pixels; range, return and reflectance stay together.

    Nothing is drawn twice: each pixel has exactly the values that it has in the scans, so that sets of independent
    pixels score alike before and after.

    Args:
        indices: numbers of the scans to shuffle, at least two.

    Yields:
        batches of scans, as many in all as there are indices. Where they do not fit into memory at once, each batch
        has scans from all over the set.
    """
    sensor = scans.images.sensor
    at_once = max(2, _PIXELS_AT_ONCE // (sensor.height * sensor.width))
    batches = max(1, len(indices) // at_once)
    rng = torch.Generator().manual_seed(seed)
    for first in range(batches):
        images = scans.batch(indices[first::batches])
        order = torch.rand(images.range_m.shape, generator=rng).argsort(dim=0)
        yield images.mapped(lambda pixels: pixels.gather(0, order))  # noqa: B023 - called at once
