"""Costs and scores of several systems → one page with a table that a reader can sort."""

import math
from collections.abc import Collection, Mapping, Sequence
from html import escape
from typing import Any

from lidargrit.core.errors import without_folders
from lidargrit.core.table import Table
from lidargrit.evaluation.intervals import Score
from lidargrit.evaluation.scorecard import Scorecard, format_value
from lidargrit.evaluation.tables import NamedCard, comparable, judge
from lidargrit.evaluation.verdict import Column, column_of, notes_on_floors
from lidargrit.viewer._page import document
from lidargrit.viewer.report_charts import REAL_AGAINST_REAL
from lidargrit.viewer.report_style import STYLE

_COSTS = {
    "parameters": "parameters",
    "training_flops": "operations of training",
    "flops_per_scan": "operations a scan",
    "network_evaluations": "network evaluations a scan",
    "seconds_per_scan": "seconds a scan",
    "bits_per_return": "bits a return",
}
_SCRIPT = """
for (const button of document.querySelectorAll("th button")) button.addEventListener("click", () => {
  const head = button.parentElement, body = head.closest("table").tBodies[0], index = head.cellIndex;
  const up = head.getAttribute("aria-sort") !== "ascending";
  for (const other of head.parentElement.children) other.removeAttribute("aria-sort");
  head.setAttribute("aria-sort", up ? "ascending" : "descending");
  const key = (row) => row.cells[index].dataset.value ?? row.cells[index].textContent;
  const compare = (a, b) => {
    const [x, y] = [key(a), key(b)];
    if (x === "" || y === "") return (x === "") - (y === "");  // cells without a number stay at the end
    const order = isNaN(x) || isNaN(y) ? x.localeCompare(y) : x - y;
    return up ? order : -order;
  };
  body.append(...[...body.rows].sort(compare));
});
"""
_LOOKS = """
th button{all:unset;cursor:pointer;font-weight:600}
th button:hover{text-decoration:underline}
th button:focus-visible{outline:3px solid var(--b);outline-offset:2px}
th[aria-sort=ascending] button::after{content:" \\25B2"}
th[aria-sort=descending] button::after{content:" \\25BC"}
main{max-width:none}
tbody th{white-space:nowrap}
td small{display:block}
tr>:first-child{position:sticky;left:0;background:var(--paper);border-right:1px solid var(--line)}
tfoot td,tfoot th{color:var(--soft)}
"""


def table_page(cells: Sequence[dict[str, Any]], flops: float) -> str:
    """Return the page as text; it needs no network and no other file, and names of systems are escaped.

    Args:
        cells: name, costs and scores of each system, as the comparison wrote them.
        flops: floating-point operations of the training of each; 0 where each had its own budget.
    """
    budget = (
        f"Each preset was trained with {flops:.2g} floating-point operations"
        if flops
        else "Each preset was trained with its own budget"
    )
    costs = {str(cell["system"]): cell["costs"] for cell in cells}
    tables = comparable([(str(cell["system"]), Scorecard.from_json(cell["scores"])) for cell in cells])
    apart = "" if len(tables) < 2 else " Systems compared with other scans, or by another sensor, have their own table."
    content = (
        f"<h1>{_systems(len(cells))}</h1>\n"
        f"<p>{escape(budget)}. Brackets hold 95 % intervals over scans. Click on a head to sort. Lower is better where "
        f"nothing else is said. A cost that is not known is -.{apart}</p>\n"
        f"<p><em>Real against real</em>, below each table, is {REAL_AGAINST_REAL}. Behind it, n is the number of scans "
        f"in a half.</p>\n{''.join(_table(cards, costs) for cards in tables)}"
    )
    return document(f"{_systems(len(cells))} compared", STYLE + _LOOKS, content, _SCRIPT)


def _systems(count: int) -> str:
    return f"{count} {'system' if count == 1 else 'systems'}"


def _table(cards: Sequence[NamedCard], costs: Mapping[str, dict[str, Any]]) -> str:
    judged = judge(cards)
    inputs = {scans.source for _, card in cards for scans in (card.samples, card.reference)}
    told: dict[str, list[str]] = {}
    for name, card in cards:
        for line in (*card.warnings, *card.deviations):
            told.setdefault(line, []).append(name)
    warnings = [f"{', '.join(names)}: {line}" for line, names in told.items()]
    scores = [score for _, card in cards for score in card.scores]
    columns = list(dict.fromkeys(map(column_of, scores)))
    higher = {column_of(score) for score in scores if score.result.higher_is_better}
    heads = [_head(each, ", higher is better" if each in higher else "") for each in columns]
    head = "".join(
        f'<th scope="col"><button type="button">{name}</button></th>' for name in ("system", *heads, *_COSTS.values())
    )
    body = "".join(_row(name, card.scores, costs[name], columns) for name, card in cards)
    reference = cards[0][1].reference
    return (
        f"<p>{reference.scans_used:,} samples of each against as many scans of "
        f"{escape(without_folders(reference.source, inputs))}, {escape(reference.sensor)}</p>\n"
        f"{_notes('warning', 'Read this first', warnings, inputs)}{_notes('note', 'In words', judged.verdicts, inputs)}"
        '<div class="wide" tabindex="0" role="region" aria-label="scores and costs"><table><thead><tr>'
        f"{head}</tr></thead><tbody>{body}</tbody><tfoot>{_real_against_real(scores, columns)}</tfoot></table></div>\n"
        f"{''.join(f'<p>{escape(note)}</p>' for note in notes_on_floors(cards[0][1].scores))}"
        f"{''.join(map(_differences, judged.differences))}"
    )


def _notes(kind: str, title: str, lines: Sequence[str], inputs: Collection[str]) -> str:
    """Return what a reader must know of the scores before the table, without the folders of the user's machine."""
    items = "".join(f"<li>{escape(without_folders(line, inputs))}</li>" for line in lines)
    return f'<section class="{kind}"><h2>{title}</h2><ul>{items}</ul></section>\n' if lines else ""


def _head(column: Column, more: str = "") -> str:
    return f"{escape(column[0])}<br><small>{escape(column[1])}{more}</small>"


def _differences(table: Table) -> str:
    """Return a table of differences, below that of the scores."""
    heads = "".join(f'<th scope="col">{escape(head)}</th>' for head in table.head)
    rows = ""
    for name, *values in table.rows:
        cells = "".join(f'<td class="number">{escape(value)}</td>' for value in values)
        rows += f'<tr><th scope="row">{escape(name)}</th>{cells}</tr>'
    return (
        f'<p>{escape(table.title)}</p>\n<div class="wide" tabindex="0" role="region" aria-label="differences"><table>'
        f"<thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table></div>\n"
    )


def _row(name: str, scores: Sequence[Score], costs: Mapping[str, Any], columns: Sequence[Column]) -> str:
    by_column = {column_of(score): score for score in scores}
    cells = [_score(by_column.get(column)) for column in columns] + [_number(costs.get(cost)) for cost in _COSTS]
    return f'<tr><th scope="row">{escape(name)}</th>{"".join(cells)}</tr>'


def _score(score: Score | None) -> str:
    if score is None:
        return '<td data-value="">-</td>'
    value, interval = score.result.value, score.interval
    limits = f"[{format_value(interval.low)}, {format_value(interval.high)}]" if interval else ""
    return f'<td class="number" data-value="{value!r}">{format_value(value)} <small>{limits}</small></td>'


def _number(value: int | float | None) -> str:
    if value is None or not math.isfinite(value):
        return '<td data-value="">-</td>'
    text = f"{value:,}" if isinstance(value, int) and value < 1e9 else f"{value:.3g}"
    return f'<td class="number" data-value="{value!r}">{text}</td>'


def _real_against_real(scores: Sequence[Score], columns: Sequence[Column]) -> str:
    found = {column_of(score): real for score in scores if (real := score.real_against_real)}
    values = (format_value(found[column].value) if column in found else "" for column in columns)
    row = "".join(f'<td class="number">{value}</td>' for value in values)
    sizes = sorted({real.num_scans for real in found.values()})
    size = f" <small>(n = {' or '.join(f'{one:,}' for one in sizes)})</small>" if sizes else ""
    return f'<tr><th scope="row">real against real{size}</th>{row}<td colspan="{len(_COSTS)}"></td></tr>'
