"""Scores with their reference rows: pixel statistics, and held-out real scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from lidargrit.errors import DataError
from lidargrit.evaluation.comparison import EvalConfig, compare_pair
from lidargrit.evaluation.intervals import RealAgainstReal, Resampling, blocks
from lidargrit.evaluation.pairs import EvalPair, EvalSet
from lidargrit.evaluation.protocols import MetricChoice
from lidargrit.evaluation.scorecard import Scorecard
from lidargrit.generators.marginal import Marginal, MarginalConfig
from lidargrit.loading import Pixels, Provenance, RangeImages
from lidargrit.structures import RangeImage


def with_pixel_statistics(card: Scorecard, pair: EvalPair, settings: EvalConfig) -> Scorecard:
    """Return a scorecard in which every score has that of pixel statistics beside it.

    Pixels are counted in every second block of the reference, and as many sampled scans compared with the other blocks;
    then the other way round. No scan is counted and compared with, and both sets are as large as the halves of real
    against real. A score is the mean of the two.

    Args:
        card: scores of the samples.
        pair: the samples and the reference of these scores.
        settings: protocol and its changes, as for the samples.
    """
    groups = blocks(len(pair.reference), settings.resampling.groups)
    if len(groups) < 2:
        return replace(card, warnings=(*card.warnings, "no pixel statistics: they need two scans to compare with"))
    even, odd = (_part(pair.reference, groups[first::2]) for first in range(2))
    values, warnings = _pixel_statistics(even, odd, pair.samples.range_m, settings, card)
    others, _ = _pixel_statistics(odd, even, pair.samples.range_m, settings, card)
    scores = (
        replace(score, pixel_statistics=(values[name] + others[name]) / 2)
        if (name := (score.result.metric, score.result.variant)) in values.keys() & others.keys()
        else score
        for score in card.scores
    )
    return replace(card, scores=tuple(scores), warnings=(*card.warnings, *warnings))


def _part(scans: EvalSet, groups: Sequence[range]) -> EvalSet:
    """Return some of the blocks of a set."""
    return replace(scans, indices=[scans.indices[index] for group in groups for index in group])


def _pixel_statistics(
    counted: EvalSet, reference: EvalSet, range_m: tuple[float, float] | None, settings: EvalConfig, card: Scorecard
) -> tuple[dict[tuple[str, str], float], tuple[str, ...]]:
    """Score scans whose pixels are sampled from those of some real scans, one by one, against others."""
    sensor, count = counted.images.sensor, len(reference)
    statistics = Marginal(MarginalConfig(), sensor)
    statistics.fit_statistics(counted)
    images = RangeImages(sensor, [ImagesInMemory(statistics.sample(range(count)))])
    scans = EvalSet("pixel statistics", images, range(count), range_m)
    return _values_of(EvalPair(scans, reference), settings, card)


def with_held_out(card: Scorecard, held_out: EvalSet, reference: EvalSet, settings: EvalConfig) -> Scorecard:
    """Return a scorecard in which real against real is the score of held-out scans, not of halves of the reference.

    Args:
        card: scores of the samples.
        held_out: other real scans.
        reference: scans of the samples' reference, as many as are held out.
        settings: protocol and its changes, as for the samples.
    """
    values, warnings = _values_of(EvalPair(held_out, reference), settings, card)
    scores = []
    for score in card.scores:
        value = values.get((score.result.metric, score.result.variant))
        real = None if value is None else RealAgainstReal(value, len(held_out), 0)
        scores.append(replace(score, real_against_real=real))
    return replace(card, scores=tuple(scores), warnings=(*card.warnings, *warnings))


def _values_of(
    pair: EvalPair, settings: EvalConfig, card: Scorecard
) -> tuple[dict[tuple[str, str], float], tuple[str, ...]]:
    """Score the metrics that a scorecard has, without intervals; return values, and a warning if there are none."""
    choices = [MetricChoice(score.result.metric, score.result.variant) for score in card.scores]
    values_alone = replace(settings, pixel_statistics=False, resampling=Resampling(halves=0))
    try:
        found = compare_pair(pair, values_alone, choices=choices)
    except DataError as error:  # not one of them, as metrics of reflectance of scans without any
        return {}, (f"no reference row: {error}",)
    return {(score.result.metric, score.result.variant): score.result.value for score in found.scores}, ()


class ImagesInMemory:
    """A store of range images that lie in memory.

    Args:
        images: a batch of range images.
    """

    provenance = Provenance()

    def __init__(self, images: RangeImage) -> None:
        self._range_m = images.range_m.numpy()

    def __len__(self) -> int:
        return len(self._range_m)

    def read(self, index: int) -> Pixels:
        """Return the ranges of one image; reflectance is not known."""
        return Pixels(self._range_m[index])
