"""Two sets and a list of metrics → scores with intervals and reference rows; shared features are computed once."""

import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch

from lidargrit.core import reporting
from lidargrit.core.determinism import scan_seed
from lidargrit.core.errors import DataError, LidarGritError, ScanError
from lidargrit.evaluation.intervals import Part, Resampling, Score, blocks, interval_of, merged, real_against_real
from lidargrit.evaluation.metrics import Metric, WholeImages, load_metric, update_together
from lidargrit.evaluation.pairs import EvalPair, EvalSet
from lidargrit.evaluation.protocols import MetricChoice
from lidargrit.scans.types import RangeImage

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


@dataclass(eq=False)
class _FedMetric:
    """One metric, fed group by group.

    Args:
        generated: metrics that were fed one group of generated scans each.
        real: metrics that were fed one group of real scans each.
        real_as_generated: metrics that were fed the same real scans as generated ones, for real against real.
        pixel_statistics: metrics that were fed pixel statistics as generated scans: of every second group of real scans
            from the first, and of the others. Empty if these are not wanted.
    """

    factory: MetricFactory
    generated: list[Part] = field(default_factory=list)
    real: list[Part] = field(default_factory=list)
    real_as_generated: list[Part] = field(default_factory=list)
    pixel_statistics: list[Part] = field(default_factory=list)

    def score(self, group_sizes: Sequence[int], resampling: Resampling, begun_s: float) -> Score:
        """Compute the value with its interval, real against real and, where they were fed, pixel statistics."""
        metric = merged(self.generated, self.real)
        result = metric.compute()
        interval = reference_row = None
        if resampling.halves:
            interval = interval_of(result.value, metric, self.generated, self.real, resampling)
            reference_row = real_against_real(metric, self.real, self.real_as_generated, group_sizes, resampling)
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
    factories: Sequence[MetricFactory], pair: EvalPair, resampling: Resampling, with_pixel_statistics: bool = False
) -> list[Score | LidarGritError]:
    """Score two sets by several metrics.

    Metrics that look at the same features of a scan, such as those of one network, are fed together, so that these are
    computed once. All others are fed one after the other, so that only one's memory is held.

    Args:
        with_pixel_statistics: whether each score gets that of pixel statistics, if there are four scans or more.

    Returns:
        the score of each metric, or why it could not be computed: no weights, no reflectance, too few scans.
    """
    found: dict[int, Score | LidarGritError] = {}
    together: dict[Hashable, list[int]] = {}
    for index, factory in enumerate(factories):
        try:
            extractor = factory().extractor(pair.samples.images.sensor)
        except LidarGritError as error:
            found[index] = error
        else:
            together.setdefault(index if isinstance(extractor, WholeImages) else extractor, []).append(index)
    sets = 3 if with_pixel_statistics else 2
    with reporting.progress("scoring", sets * len(pair.samples) * len(factories)) as progress:
        for indices in together.values():
            fed = {index: _FedMetric(factories[index]) for index in indices}
            note = ", ".join(factories[index].choice.metric for index in indices)
            begun_s = time.perf_counter()
            try:
                advance = partial(progress.advance, note=note)
                sizes = _feed(list(fed.values()), pair, resampling, advance)
                if with_pixel_statistics:
                    _feed_pixel_statistics(list(fed.values()), pair.reference, resampling, advance)
            except ScanError:
                raise
            except LidarGritError as error:
                found |= dict.fromkeys(indices, error)
                continue
            feeding_s = (time.perf_counter() - begun_s) / len(indices)
            for index, metric in fed.items():
                try:
                    found[index] = metric.score(sizes, resampling, time.perf_counter() - feeding_s)
                except LidarGritError as error:
                    found[index] = error
    return [found[index] for index in range(len(factories))]


def _feed(
    fed: Sequence[_FedMetric], pair: EvalPair, resampling: Resampling, advance: Callable[[int], None]
) -> list[int]:
    """Feed both sets to metrics that share features, and return the number of scans in each group."""
    groups = blocks(len(pair.samples), resampling.groups if resampling.halves else 1)
    for real, images in ((False, pair.samples), (True, pair.reference)):
        for group in groups:
            parts = [each.factory() for each in fed]
            as_generated = [each.factory() for each in fed] if real and resampling.halves else []
            for metric in (*parts, *as_generated):
                metric.first_image = group.start
            metrics = [(metric, real) for metric in parts] + [(metric, False) for metric in as_generated]
            for first in range(0, len(group), _BATCH):
                batch = images.batch(group[first : first + _BATCH])
                update_together(metrics, batch)
                advance(len(fed) * len(batch))
            for each, metric in zip(fed, parts, strict=True):
                (each.real if real else each.generated).append(Part(metric))
            for each, metric in zip(fed, as_generated, strict=False):
                each.real_as_generated.append(Part(metric))
    return [len(group) for group in groups]


def _feed_pixel_statistics(
    fed: Sequence[_FedMetric], reference: EvalSet, resampling: Resampling, advance: Callable[[int], None]
) -> None:
    """Feed pixel statistics of every second group, then of the others, to metrics that share features."""
    groups = blocks(len(reference), resampling.groups)
    for half in range(2):
        indices = [index for group in groups[half::2] for index in group]
        if len(groups) < 2 or len(indices) < 2:  # one scan has nothing to be shuffled with
            return
        metrics = [each.factory() for each in fed]
        for images in pixel_statistics(reference, indices, scan_seed(resampling.seed, 3, half)):
            for first in range(0, len(images), _BATCH):
                batch = images[first : first + _BATCH]
                update_together([(metric, False) for metric in metrics], batch)
                advance(len(fed) * len(batch))
        for each, metric in zip(fed, metrics, strict=True):
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
