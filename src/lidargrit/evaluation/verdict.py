"""Scores between their two reference rows → a verdict in words: what beats pixel statistics, what is like real scans.

Every score table of this program knows three bounds, by these names alone:

- *real against real*: one half of the real scans, scored as if it had been generated, against the other half. Between
  as many scans, no generator can be expected to do better.
- *pixel statistics*: scans each of whose pixels comes from another real scan, or scans of the generator ``marginal``,
  which samples every pixel by itself. A model must do better.
- *memorised training scans*: scans of the generator ``memorised``. They score like real scans, and nothing is new.
"""

from __future__ import annotations

from collections.abc import Sequence

from lidargrit.evaluation.intervals import Score

PIXEL_STATISTICS, MEMORISED = "marginal", "memorised"
"""The generators whose scans may stand for the second bound, and are the third."""

_SPREADS = 2.8  # Student's 97.5 % quantile for the five halvings of real against real


def noise(score: Score) -> float:
    """Return half the width of a score's interval, 0 without one."""
    if score.interval is None:
        return 0.0
    return max(score.interval.high - score.result.value, score.result.value - score.interval.low)


def beats_pixel_statistics(score: Score) -> bool | None:
    """Return whether a score beats that of pixel statistics by more than chance; None where that is not known."""
    halves = value_of_halves(score)
    if score.pixel_statistics is None or halves is None:
        return None
    return _worse_by(score, score.pixel_statistics, halves) > noise(score)


def is_like_real(score: Score) -> bool | None:
    """Return whether a score is not worse than real against real by more than chance; None where that is not known."""
    real = score.real_against_real
    if real is None or (value := value_of_halves(score)) is None:
        return None
    return _worse_by(score, value, real.value) <= noise(score)


def tells_apart(score: Score) -> bool | None:
    """Return whether the metric separates pixel statistics from real scans by more than chance; None if not known.

    Chance is that of real against real, since the model's own noise must not decide which scores count; that noise
    stands in where it is not known.
    """
    real = score.real_against_real
    if score.pixel_statistics is None or real is None:
        return None
    chance = noise(score) if real.spread is None else _SPREADS * real.spread
    return _worse_by(score, score.pixel_statistics, real.value) > chance


def counted_first(scores: Sequence[Score]) -> tuple[list[Score], list[Score]]:
    """Divide scores into those that count, and those whose metric cannot tell pixel statistics from real scans."""
    apart = [score for score in scores if tells_apart(score) is False]
    return [score for score in scores if tells_apart(score) is not False], apart


def verdict(scores: Sequence[Score]) -> tuple[str, ...]:
    """Return in a few sentences how scores stand to real against real and to pixel statistics.

    Args:
        scores: scores of one set of samples, with their reference rows where these are known.

    Returns:
        no sentence if there is neither reference row; else the count, then which metrics were set apart and why, then
        what a value below 0 or better than real against real means.
    """
    counted, apart = counted_first(scores)
    sentences = [sentence] if (sentence := _count(counted)) else []
    if apart:
        sentences.append(
            f"Set apart, and not counted: {_names(apart)}. Here "
            f"{'they do' if len(apart) > 1 else 'it does'} not tell pixel statistics from real scans."
        )
    if below := [score for score in scores if score.result.value < 0]:
        sentences.append(
            f"{_names(below)} below 0: the unbiased estimate of a squared distance scatters around 0 for sets that do "
            "not differ; read it as 0."
        )
    if beyond := [score for score in counted if _is_beyond_real(score)]:
        sentences.append(
            f"Better than real against real: {_names(beyond)}. Either the samples repeat scans of the reference, or "
            "they vary less than real ones."
        )
    return tuple(sentences)


def _count(scores: Sequence[Score]) -> str:
    """Return the sentence that counts, or "" if neither reference row is known."""
    beaten = [known for score in scores if (known := beats_pixel_statistics(score)) is not None]
    real = [known for score in scores if (known := is_like_real(score)) is not None]
    words = []
    if beaten:
        words.append(f"better than pixel statistics in {sum(beaten)} of {len(beaten)} scores")
    if real:
        words.append(f"within noise of real against real in {sum(real)}{'' if beaten else f' of {len(real)} scores'}")
    sentence = "; ".join(words)
    return f"{sentence[0].upper()}{sentence[1:]}." if sentence else ""


def _is_beyond_real(score: Score) -> bool:
    real = score.real_against_real
    if real is None or (value := value_of_halves(score)) is None:
        return False
    return _worse_by(score, real.value, value) > noise(score)


def value_of_halves(score: Score) -> float | None:
    """Return the mean score of halves of both sets, since most metrics are worse for fewer scans; None if not known."""
    return None if score.interval is None else score.interval.mean_of_halves


def _worse_by(score: Score, value: float, other: float) -> float:
    """Return by how much one value of a metric is worse than another one of the same metric."""
    return other - value if score.result.higher_is_better else value - other


def _names(scores: Sequence[Score]) -> str:
    """Return the names of metrics, each with its variant where several variants of it were scored."""
    metrics = [score.result.metric for score in scores]
    return ", ".join(
        name if metrics.count(name) == 1 else f"{name} ({score.result.variant})"
        for name, score in zip(metrics, scores, strict=True)
    )
