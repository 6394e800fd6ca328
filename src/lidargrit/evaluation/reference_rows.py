"""Scores with their reference rows: pixel statistics, and held-out real scans."""

from __future__ import annotations

from dataclasses import replace

from lidargrit.errors import DataError
from lidargrit.evaluation.comparison import EvalConfig, compare_pair
from lidargrit.evaluation.intervals import RealAgainstReal, Resampling
from lidargrit.evaluation.pairs import EvalPair, EvalSet
from lidargrit.evaluation.scorecard import Scorecard
from lidargrit.evaluation.verdict import PIXEL_STATISTICS
from lidargrit.generators import load_class
from lidargrit.loading import Pixels, Provenance, RangeImages
from lidargrit.structures import RangeImage


def with_pixel_statistics(card: Scorecard, pair: EvalPair, real: RangeImages, settings: EvalConfig) -> Scorecard:
    """Return a scorecard in which every score has that of pixel statistics beside it.

    Args:
        card: scores of the samples.
        pair: the samples and the reference of these scores.
        real: real scans whose pixels are counted.
        settings: protocol and its changes, as for the samples.
    """
    marginal = load_class(PIXEL_STATISTICS)
    statistics = marginal(marginal.Config(), real.sensor)
    statistics.fit_statistics(real)
    count = len(pair.samples)
    images = RangeImages(real.sensor, [ImagesInMemory(statistics.sample(range(count)))])
    scans = EvalSet("pixel statistics", images, range(count), pair.samples.range_m)
    values, warnings = _values_of(EvalPair(scans, pair.reference), settings, card)
    scores = (replace(s, pixel_statistics=values.get((s.result.metric, s.result.variant))) for s in card.scores)
    return replace(card, scores=tuple(scores), warnings=(*card.warnings, *warnings))


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
    metrics = tuple(dict.fromkeys(score.result.metric for score in card.scores))
    try:
        found = compare_pair(pair, replace(settings, metrics=metrics, resampling=Resampling(halves=0)))
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
