"""Scores and curves → tables and charts inside a page: HTML, and SVG in the colours of the page."""

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from lidargrit.evaluation.intervals import Score
from lidargrit.evaluation.metrics import load_metric
from lidargrit.evaluation.scorecard import NOT_APPLICABLE, Scorecard
from lidargrit.evaluation.verdict import notes_on_floors
from lidargrit.viewer._page import part

_CHART_WIDE, _CHART_TALL = 720, 260
_LEFT, _RIGHT, _TOP, _BOTTOM = 48, 12, 12, 40
REAL_AGAINST_REAL = (
    "the score of one half of the reference against its other half. No generator can be expected to do better. The "
    "halves are smaller than the sets, and most metrics fall as sets grow, so a good score may still lie below it"
)
_HEADS = ("metric", "score", "95 % interval", "real against real", "pixel statistics", "chart", "better")


def score_chart(score: Score) -> str:
    """Plot a score as a dot on its interval, from 0, with real against real as an upright line.

    Pixel statistics, where their score is known, are a square.
    """
    interval, real = score.interval, score.real_against_real
    marks = {"value": score.result.value, "pixels": score.pixel_statistics, "real": real and real.value}
    marks |= {"low": interval and interval.low, "high": interval and interval.high}
    known = {name: mark for name, mark in marks.items() if mark is not None}
    if not np.isfinite([*known.values()]).all():
        return ""
    first, last = min(0.0, *known.values()), max(0.0, *known.values())
    spread = (last - first) or 1.0
    x = {name: round(10 + (mark - first) / spread * 300, 1) for name, mark in {**known, "zero": 0.0}.items()}
    return part("score_chart.html", marks=known, x=x)


def line_chart(lines: Mapping[str, Float[np.ndarray, " n"]], x_label: str, y_label: str, x_ticks: Sequence[int]) -> str:
    """Plot shares from 0 to 1, one line for each name: the first solid, the second dashed."""
    count = max(len(values) for values in lines.values())
    wide, tall = _CHART_WIDE - _LEFT - _RIGHT, _CHART_TALL - _TOP - _BOTTOM

    def point(index: int, share: float) -> tuple[float, float]:
        return _LEFT + index / max(count - 1, 1) * wide, _TOP + (1 - share) * tall

    parts = []
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        (left, y), (right, _) = point(0, share), point(count - 1, share)
        parts.append(f'<line class="grid" x1="{left:.1f}" y1="{y:.1f}" x2="{right:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{left - 6:.1f}" y="{y + 4:.1f}" text-anchor="end">{share:.0%}</text>')
    for tick in x_ticks:
        x, y = point(tick, 0.0)
        parts.append(f'<text x="{x:.1f}" y="{y + 16:.1f}" text-anchor="middle">{tick}</text>')
    for number, (name, values) in enumerate(lines.items()):
        points = " ".join("{:.1f},{:.1f}".format(*point(i, float(v))) for i, v in enumerate(values))
        parts.append(f'<polyline class="line line{number}" points="{points}"><title>{escape(name)}</title></polyline>')
    parts.append(
        f'<text x="{_LEFT + wide / 2:.1f}" y="{_CHART_TALL - 6}" text-anchor="middle">{escape(x_label)}</text>'
    )
    spoken = escape(f"{y_label} by {x_label}: " + " and ".join(lines))
    return f'<svg class="chart" viewBox="0 0 {_CHART_WIDE} {_CHART_TALL}" role="img" aria-label="{spoken}">' + (
        "".join(parts) + "</svg>"
    )


def score_table(card: Scorecard) -> Markup:
    """Return the verdict on some scores, then their table, with a row for each metric that does not apply."""
    with_pixels = any(score.pixel_statistics is not None for score in card.scores)
    heads = [head for head in _HEADS if head != "pixel statistics" or with_pixels]
    names = [score.result.metric for score in card.scores]
    names += [each.metric for each in card.left_out if each.verdict == NOT_APPLICABLE]
    titles = {name: load_metric(name).title for name in names}
    floors = notes_on_floors(card.scores)
    return part("scores.html", card=card, heads=heads, titles=titles, floors=floors, chart=score_chart)
