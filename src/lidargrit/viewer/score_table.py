"""Scores between their reference rows → the verdict in words and a table below it, in HTML."""

from html import escape

from lidargrit.evaluation.intervals import Score
from lidargrit.evaluation.metrics import load_metric
from lidargrit.evaluation.scorecard import NOT_APPLICABLE, Scorecard, format_value
from lidargrit.evaluation.verdict import notes_on_floors
from lidargrit.viewer.report_charts import score_chart

REAL_AGAINST_REAL = (
    "the score of one half of the reference against its other half. No generator can be expected to do better. The "
    "halves are smaller than the sets, and most metrics fall as sets grow, so a good score may still lie below it"
)
_HEADS = ("metric", "score", "95 % interval", "real against real", "pixel statistics", "chart", "better")


def score_table(card: Scorecard) -> str:
    """Return the verdict on some scores, then their table, with a row for each metric that does not apply."""
    with_pixels = any(score.pixel_statistics is not None for score in card.scores)
    heads = [head for head in _HEADS if head != "pixel statistics" or with_pixels]
    rows = "".join(_row(score, len(heads)) for score in card.scores)
    rows += "".join(
        f'<tr><th scope="row">{metric_title(each.metric, each.variant)}</th>'
        f'<td colspan="{len(heads) - 1}">{NOT_APPLICABLE}</td></tr>'
        for each in card.left_out
        if each.verdict == NOT_APPLICABLE
    )
    sentences = "".join(f"<li>{escape(sentence)}</li>" for sentence in card.verdict.sentences)
    columns = "".join(f'<th scope="col">{head}</th>' for head in heads)
    return (
        f'<ul class="verdict">{sentences}</ul>'
        '<div class="wide scores" tabindex="0" role="region" aria-label="scores"><table><thead><tr>'
        f"{columns}</tr></thead><tbody>{rows}</tbody></table></div>"
        + "".join(f"<p>{escape(note)}</p>" for note in notes_on_floors(card.scores))
    )


def metric_title(name: str, variant: str) -> str:
    """Return a metric's title with its name and variant below, for the head of a row."""
    return f"{escape(load_metric(name).title)}<br><small>{escape(name)}, {escape(variant)}</small>"


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
    named = zip(_HEADS[1:], cells, strict=False)
    numbers = "".join(f'<td class="number" data-name="{name}">{cell}</td>' for name, cell in named)
    better = "higher" if result.higher_is_better else "lower"
    return (
        f'<tr><th scope="row">{metric_title(result.metric, result.variant)}</th>{numbers}'
        f'<td>{score_chart(score)}</td><td data-name="better">{better}</td></tr>'
    )
