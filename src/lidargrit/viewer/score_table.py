"""Scores between their reference rows → the verdict in words and a table below it, in HTML."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from lidargrit.evaluation.intervals import Score
from lidargrit.evaluation.metrics import load_metric
from lidargrit.evaluation.scorecard import NOT_APPLICABLE, LeftOut, format_value
from lidargrit.evaluation.verdict import counted_first, verdict
from lidargrit.viewer.report_charts import score_chart

REAL_AGAINST_REAL = (
    "the score of one half of the reference against its other half. No generator can be expected to do better. The "
    "halves are smaller than the sets, and most metrics fall as sets grow, so a good score may still lie below it"
)
_HEADS = ("metric", "score", "95 % interval", "real against real", "pixel statistics", "chart", "better")


def score_table(scores: Sequence[Score], not_applicable: Sequence[LeftOut] = ()) -> str:
    """Return the verdict of some scores in words, then their table; metrics that are set apart come last.

    Args:
        scores: scores with their intervals and reference rows, as far as these are known.
        not_applicable: metrics that do not apply to these sets, which get rows without numbers.
    """
    counted, apart = counted_first(scores)
    heads = [head for head in _HEADS if head != "pixel statistics" or _has_pixel_statistics(scores)]
    rows = "".join(_row(score, len(heads)) for score in counted)
    rows += "".join(
        f'<tr><th scope="row">{metric_title(each.metric, each.variant)}</th>'
        f'<td colspan="{len(heads) - 1}">{NOT_APPLICABLE}</td></tr>'
        for each in not_applicable
    )
    if apart:
        rows += (
            f'<tr><td class="apart" colspan="{len(heads)}">Set apart: these metrics do not tell pixel statistics from '
            "real scans here, so a good score says little.</td></tr>"
        )
        rows += "".join(_row(score, len(heads)) for score in apart)
    sentences = "".join(f"<li>{escape(sentence)}</li>" for sentence in verdict(scores))
    columns = "".join(f'<th scope="col">{head}</th>' for head in heads)
    return (
        (f'<ul class="verdict">{sentences}</ul>' if sentences else "")
        + '<div class="wide" tabindex="0" role="region" aria-label="scores"><table><thead><tr>'
        + f"{columns}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def metric_title(name: str, variant: str) -> str:
    """Return a metric's title with its name and variant below, for the head of a row."""
    return f"{escape(load_metric(name).title)}<br><small>{escape(name)}, {escape(variant)}</small>"


def _has_pixel_statistics(scores: Sequence[Score]) -> bool:
    return any(score.pixel_statistics is not None for score in scores)


def _row(score: Score, columns: int) -> str:
    result, interval, real, pixels = score.result, score.interval, score.real_against_real, score.pixel_statistics
    between = f"{format_value(interval.low)} to {format_value(interval.high)}" if interval else "not known"
    cells = [
        format_value(result.value),
        between,
        f"{format_value(real.value)} <small>(n = {real.num_scans:,})</small>" if real else "not known",
    ]
    if columns == len(_HEADS):
        cells.append("not known" if pixels is None else format_value(pixels))
    numbers = "".join(f'<td class="number">{cell}</td>' for cell in cells)
    better = "higher" if result.higher_is_better else "lower"
    return (
        f'<tr><th scope="row">{metric_title(result.metric, result.variant)}</th>{numbers}'
        f"<td>{score_chart(score)}</td><td>{better}</td></tr>"
    )
