"""Scores and curves → tables and charts inside a page: HTML, and SVG in the colours of the page."""

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from lidargrit.evaluation.intervals import Score
from lidargrit.evaluation.metrics import load_metric
from lidargrit.evaluation.scorecard import NOT_APPLICABLE, Scorecard, format_value
from lidargrit.evaluation.verdict import notes_on_floors
from lidargrit.viewer._page import part

_WIDE, _TALL = 320, 34  # a score's chart
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
    value, interval, pixels = score.result.value, score.interval, score.pixel_statistics
    real = None if score.real_against_real is None else score.real_against_real.value
    low, high = (interval.low, interval.high) if interval else (value, value)
    marks = [low, high, value, *(mark for mark in (real, pixels) if mark is not None)]
    if not np.isfinite(marks).all():
        return ""
    first, last = min(0.0, *marks), max(0.0, *marks)
    spread = (last - first) or 1.0

    def x(at: float) -> float:
        return 10 + (at - first) / spread * (_WIDE - 20)

    middle = _TALL / 2
    spoken = f"score {format_value(value)}"
    parts = [f'<line class="axis" x1="10" y1="{middle}" x2="{_WIDE - 10}" y2="{middle}"/>']
    parts.append(f'<line class="axis" x1="{x(0.0):.1f}" y1="{middle - 5}" x2="{x(0.0):.1f}" y2="{middle + 5}"/>')
    parts.append(f'<text class="zero" x="{x(0.0):.1f}" y="{_TALL - 1}" text-anchor="middle">0</text>')
    if interval:
        spoken += f", 95 % interval {format_value(low)} to {format_value(high)}"
        parts.append(f'<line class="interval" x1="{x(low):.1f}" y1="{middle}" x2="{x(high):.1f}" y2="{middle}"/>')
    if real is not None:
        spoken += f", real against real {format_value(real)}"
        parts.append(f'<line class="real" x1="{x(real):.1f}" y1="4" x2="{x(real):.1f}" y2="{_TALL - 4}"/>')
    if pixels is not None:
        spoken += f", pixel statistics {format_value(pixels)}"
        parts.append(f'<rect class="pixels" x="{x(pixels) - 5:.1f}" y="{middle - 5}" width="10" height="10"/>')
    parts.append(f'<circle class="dot" cx="{x(value):.1f}" cy="{middle}" r="5"/>')
    return (
        f'<svg viewBox="0 0 {_WIDE} {_TALL}" width="{_WIDE}" height="{_TALL}" role="img" aria-label="{escape(spoken)}">'
        + "".join(parts)
        + "</svg>"
    )


def bar_chart(bars: Mapping[str, float], unit: str) -> str:
    """Plot amounts as bars below one another, each with its name on the left and its value on the right."""
    highest = max([*bars.values(), 1e-9])
    rows = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td><svg viewBox="0 0 {_WIDE} 14" width="{_WIDE}" height="14" '
        f'aria-hidden="true"><rect class="bar" width="{max(value / highest * _WIDE, 1):.1f}" height="14" rx="2"/></svg>'
        f'</td><td class="number">{value:,.1f} {escape(unit)}</td></tr>'
        for name, value in bars.items()
    )
    return f"<table><tbody>{rows}</tbody></table>"


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
