"""Costs and scores of several systems → one page with a table that a reader can sort."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Any

from lidargrit.core.errors import without_folders
from lidargrit.evaluation.scorecard import format_value
from lidargrit.evaluation.verdict import MEMORISED, PIXEL_STATISTICS
from lidargrit.viewer._page import document
from lidargrit.viewer.report_style import STYLE
from lidargrit.viewer.score_table import REAL_AGAINST_REAL

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
    tables: dict[tuple[str, str, int], list[dict[str, Any]]] = {}
    for cell in cells:
        tables.setdefault(_comparable(cell), []).append(cell)
    apart = "" if len(tables) < 2 else " Systems compared with other scans, or by another sensor, have their own table."
    content = (
        f"<h1>{_systems(len(cells))}</h1>\n"
        f"<p>{escape(budget)}. Brackets hold 95 % intervals over scans. Click on a head to sort. Lower is better where "
        f"nothing else is said. A cost that is not known is -.{apart}</p>\n"
        f"<p><em>Real against real</em>, below each table, is {REAL_AGAINST_REAL}. Behind it, n is the number of scans "
        f"in a half.</p>\n{''.join(map(_table, tables.values()))}"
    )
    return document(f"{_systems(len(cells))} compared", STYLE + _LOOKS, content, _SCRIPT)


def _systems(count: int) -> str:
    return f"{count} {'system' if count == 1 else 'systems'}"


def _comparable(cell: dict[str, Any]) -> tuple[str, str, int]:
    """Return what the systems of one table have in common: protocol, and scans of the reference."""
    reference = cell["scores"]["inputs"]["reference"]
    return str(cell["scores"]["protocol"]["name"]), str(reference["sha256"]), int(reference["scans_used"])


def _table(cells: Sequence[dict[str, Any]]) -> str:
    columns = list(dict.fromkeys(_column(score) for cell in cells for score in cell["scores"]["scores"]))
    heads = ["system", *(f"{metric}<br><small>{variant}</small>" for metric, variant in columns), *_COSTS.values()]
    head = "".join(f'<th scope="col"><button type="button">{name}</button></th>' for name in heads)
    body = "".join(_row(cell, columns) for cell in cells)
    reference = cells[0]["scores"]["inputs"]["reference"]
    return (
        f"<p>{int(reference['scans_used']):,} samples of each against as many scans of "
        f"{escape(_without_folders(str(reference['source']), cells))}, {escape(str(reference['sensor']))}</p>\n"
        f"{_told(cells)}"
        '<div class="wide" tabindex="0" role="region" aria-label="scores and costs"><table><thead><tr>'
        f"{head}</tr></thead><tbody>{body}</tbody><tfoot>{_real_against_real(cells, columns)}</tfoot></table></div>\n"
    )


def _told(cells: Sequence[dict[str, Any]]) -> str:
    """Return what a reader must know of the scores before the table: warnings, and the verdict on each system."""
    kinds = {"warning": "Read this first", "note": "In words"}
    said: dict[str, dict[str, list[str]]] = {kind: {} for kind in kinds}
    for cell in cells:
        scores, system = cell["scores"], str(cell["system"])
        for line in (*scores.get("warnings", ()), *scores.get("deviations", ())):
            said["warning"].setdefault(_without_folders(str(line), cells), []).append(system)
        if (verdict := scores.get("verdict")) and system not in (PIXEL_STATISTICS, MEMORISED):
            said["note"].setdefault(" ".join(map(str, verdict)), []).append(system)
    return "".join(
        f'<section class="{kind}"><h2>{title}</h2><ul>'
        + "".join(f"<li>{escape(', '.join(systems))}: {escape(line)}</li>" for line, systems in said[kind].items())
        + "</ul></section>\n"
        for kind, title in kinds.items()
        if said[kind]
    )


def _without_folders(text: str, cells: Sequence[dict[str, Any]]) -> str:
    """Return a text without the folders of the user's machine, for a page that others may see."""
    inputs = (scans for cell in cells for scans in cell["scores"]["inputs"].values())
    return without_folders(text, {str(scans["source"]) for scans in inputs})


def _column(score: dict[str, Any]) -> tuple[str, str]:
    better = ", higher is better" if score["higher_is_better"] else ""
    return escape(str(score["metric"])), escape(f"{score['variant']}{better}")


def _row(cell: dict[str, Any], columns: Sequence[tuple[str, str]]) -> str:
    scores = {_column(score): score for score in cell["scores"]["scores"]}
    found = [_score(scores.get(column)) for column in columns]
    costs = [_number(cell["costs"].get(name)) for name in _COSTS]
    return f'<tr><th scope="row">{escape(str(cell["system"]))}</th>{"".join([*found, *costs])}</tr>'


def _score(score: dict[str, Any] | None) -> str:
    if score is None or score["value"] is None:
        return '<td data-value="">-</td>'
    interval = score["interval"]
    limits = f"[{format_value(interval['low'])}, {format_value(interval['high'])}]" if interval else ""
    value = float(score["value"])
    return f'<td class="number" data-value="{value!r}">{format_value(value)} <small>{limits}</small></td>'


def _number(value: int | float | None) -> str:
    if value is None or not math.isfinite(value):
        return '<td data-value="">-</td>'
    text = f"{value:,}" if isinstance(value, int) and value < 1e9 else f"{value:.3g}"
    return f'<td class="number" data-value="{value!r}">{text}</td>'


def _real_against_real(cells: Sequence[dict[str, Any]], columns: Sequence[tuple[str, str]]) -> str:
    values, sizes = {}, set()
    for score in (score for cell in cells for score in cell["scores"]["scores"]):
        if score["real_against_real"] is not None:
            values[_column(score)] = score["real_against_real"]["value"]
            sizes.add(int(score["real_against_real"]["num_scans"]))
    row = [f'<td class="number">{format_value(values[column]) if column in values else ""}</td>' for column in columns]
    size = f" <small>(n = {' or '.join(f'{one:,}' for one in sorted(sizes))})</small>" if sizes else ""
    return f'<tr><th scope="row">real against real{size}</th>{"".join(row)}<td colspan="{len(_COSTS)}"></td></tr>'
