"""Costs and scores of several systems → one page with a table that a reader can sort."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from lidargrit.core.errors import without_folders
from lidargrit.evaluation.costs import HEADS
from lidargrit.evaluation.scorecard import Scorecard
from lidargrit.evaluation.tables import NamedCard, comparable, judge
from lidargrit.evaluation.verdict import column_of, notes_on_floors
from lidargrit.viewer._page import asset, document, part
from lidargrit.viewer.report_charts import REAL_AGAINST_REAL


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
        costs=list(HEADS.values()),
    )
    return document(
        f"{_systems(len(cells))} compared", asset("report.css") + asset("table.css"), content, asset("table.js")
    )


def _systems(count: int) -> str:
    return f"{count} {'system' if count == 1 else 'systems'}"


def _table(cards: Sequence[NamedCard], costs: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
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
            (name, [scored.get(column) for column in columns], [_number(costs[name].get(cost)) for cost in HEADS])
            for (name, _), scored in zip(cards, by_column, strict=True)
        ],
        "real": [real.get(column) for column in columns],
        "size": " or ".join(sizes),
        "floors": notes_on_floors(cards[0][1].scores),
        "differences": judged.differences,
    }


def _number(value: int | float | None) -> tuple[str, str]:
    if value is None or not math.isfinite(value):
        return "", "-"
    return repr(value), f"{value:,}" if isinstance(value, int) and value < 1e9 else f"{value:.3g}"
