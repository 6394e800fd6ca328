"""Costs and scores of several systems → one page with a table that a reader can sort."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from lidargrit.core.errors import without_folders
from lidargrit.evaluation.scorecard import Scorecard
from lidargrit.evaluation.tables import NamedCard, comparable, judge
from lidargrit.evaluation.verdict import column_of, notes_on_floors
from lidargrit.viewer._page import document, part
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
    content = part(
        "table.html",
        title=_systems(len(cells)),
        budget=budget,
        apart=len(tables) > 1,
        real_against_real=REAL_AGAINST_REAL,
        tables=[_table(cards, costs) for cards in tables],
        costs=list(_COSTS.values()),
    )
    return document(f"{_systems(len(cells))} compared", STYLE + _LOOKS, content, _SCRIPT)


def _systems(count: int) -> str:
    return f"{count} {'system' if count == 1 else 'systems'}"


def _table(cards: Sequence[NamedCard], costs: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """Return what the template needs of systems that were compared with the same scans."""
    judged = judge(cards)
    inputs = {scans.source for _, card in cards for scans in (card.samples, card.reference)}
    told: dict[str, list[str]] = {}
    for name, card in cards:
        for line in (*card.warnings, *card.deviations):
            told.setdefault(line, []).append(name)
    scores = [score for _, card in cards for score in card.scores]
    by_column = [{column_of(score): score for score in card.scores} for _, card in cards]
    columns = list(dict.fromkeys(map(column_of, scores)))
    real = {column_of(score): real for score in scores if (real := score.real_against_real)}
    sizes = sorted({f"{each.num_scans:,}" for each in real.values()})
    return {
        "used": cards[0][1].reference.scans_used,
        "source": without_folders(cards[0][1].reference.source, inputs),
        "sensor": cards[0][1].reference.sensor,
        "warnings": [without_folders(f"{', '.join(names)}: {line}", inputs) for line, names in told.items()],
        "verdicts": [without_folders(line, inputs) for line in judged.verdicts],
        "columns": columns,
        "higher": {column_of(score) for score in scores if score.result.higher_is_better},
        "rows": [
            (name, [scored.get(column) for column in columns], [_number(costs[name].get(cost)) for cost in _COSTS])
            for (name, _), scored in zip(cards, by_column, strict=True)
        ],
        "real": [real.get(column) for column in columns],
        "size": " or ".join(sizes),
        "floors": notes_on_floors(cards[0][1].scores),
        "differences": judged.differences,
    }


def _number(value: int | float | None) -> tuple[str, str]:
    """Return a cost to sort by, and to read."""
    if value is None or not math.isfinite(value):
        return "", "-"
    return repr(value), f"{value:,}" if isinstance(value, int) and value < 1e9 else f"{value:.3g}"
