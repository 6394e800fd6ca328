"""Several systems side by side: files of scores → text, Markdown or LaTeX; published scores in blocks of their own."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import resources
from itertools import chain
from pathlib import Path
from typing import Any, Literal

from lidargrit.core.errors import DataError, printable
from lidargrit.core.files import read_json, write_json
from lidargrit.evaluation.differences import Comparison, compare_systems
from lidargrit.evaluation.intervals import Score, format_value
from lidargrit.evaluation.scorecard import NOT_APPLICABLE, LeftOut, Scorecard
from lidargrit.evaluation.verdict import (
    MEMORISED,
    PIXEL_STATISTICS,
    Column,
    column_of,
    notes_on_floors,
    value_of_halves,
)

NamedCard = tuple[str, Scorecard]  # name of a system, and its scores
Format = Literal["text", "markdown", "latex"]
_BOUNDS = {PIXEL_STATISTICS: " (pixel statistics)", MEMORISED: " (memorised training scans)"}


@dataclass(frozen=True)
class TableBlock:
    """Rows that may be compared with one another.

    Args:
        title: title of the block.
        columns: metrics and variants.
        rows: name of a system with its scores, one for each column, "" where there is none.
        notes: lines printed below the rows.
        verdicts: lines printed above the rows, one for each system or pair of systems.
    """

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str, tuple[str, ...]], ...]
    notes: tuple[str, ...] = ()
    verdicts: tuple[str, ...] = ()


def side_by_side(paths: Sequence[Path], form: Format = "text") -> str:
    """Set the scores of several files side by side.

    Rows share a block only if they were measured by one protocol against the very same reference. Published scores
    never stand among measured ones: they get blocks of their own, and only where the measured rows are what the
    protocol wants; else a line says why they do not compare. A file called ``marginal`` is the row of pixel statistics,
    and one called ``memorised`` that of memorised training scans.

    Args:
        paths: files that ``lidargrit evaluate --json`` wrote.
        form: format of the table.
    """
    if not paths:
        raise DataError("no file of scores", "at least one", "write some with: lidargrit evaluate ... --json FILE")
    measured = comparable([(name, Scorecard.read(path)) for path, name in zip(paths, _names(paths), strict=True)])
    return render([block for cards in measured for block in (*_measured(cards), *_published(cards))], form)


def comparable(cards: Sequence[NamedCard]) -> list[list[NamedCard]]:
    """Divide the scores of systems into those that were measured by one protocol against the very same scans."""
    found: dict[tuple[str, str, int], list[NamedCard]] = {}
    for name, card in cards:
        key = (card.protocol, card.reference.sha256, card.reference.scans_used)
        found.setdefault(key, []).append((name, card))
    return list(found.values())


def share_pixel_statistics(paths: Sequence[Path]) -> None:
    """Write those of the row that holds them into the files of all systems: read alone, each gives the same verdict."""
    for cards in comparable([(str(path.with_suffix("")), Scorecard.read(path)) for path in paths]):
        for (name, card), (_, before) in zip(_with_pixel_statistics(cards), cards, strict=True):
            if card != before:
                write_json(Path(f"{name}.json"), card.to_json())


def render(blocks: Sequence[TableBlock], form: Format = "text") -> str:
    """Return blocks of a table, one below the other."""
    return "\n\n".join(_RENDERERS[form](block) for block in blocks)


def read_tables(paths: Sequence[Path], form: Format = "text") -> tuple[str, dict[str, Any]]:
    """Return the scores of several files side by side, and the content of each file by its name."""
    return side_by_side(paths, form), {name: read_json(path) for path, name in zip(paths, _names(paths), strict=True)}


def _names(paths: Sequence[Path]) -> list[str]:
    """Return the name of the system of each file: that of the file, with its folder where several have one name."""
    stems = [path.stem for path in paths]
    return [path.stem if stems.count(path.stem) == 1 else str(path.with_suffix("")) for path in paths]


def _system(name: str) -> str:
    """Return the name of a row without the folder that tells it from others of this name."""
    return Path(name).name


@dataclass(frozen=True)
class Judged:
    """Systems that were scored by one protocol against the same scans, and all that is said of them.

    Args:
        cards: name and scores of each, with the pixel statistics of the row that holds them, if there is one.
        verdicts: a line for each system, and one for each compared with the first; none for the bounds.
        differences: a block of these differences; none for a single system.
    """

    cards: tuple[NamedCard, ...]
    verdicts: tuple[str, ...]
    differences: tuple[TableBlock, ...]


def judge(cards: Sequence[NamedCard]) -> Judged:
    """Say of systems scored alike how each stands to the bounds, and which are better than the first of them."""
    cards = _with_pixel_statistics(cards)
    systems = [(name, card) for name, card in cards if _system(name) not in _BOUNDS]
    said = tuple(f"{name}: {' '.join(card.verdict.sentences)}" for name, card in systems)
    if len(systems) < 2:
        return Judged(tuple(cards), said, ())
    (first, with_card), *others = systems
    compared = [(name, compare_systems(name, card, first, with_card)) for name, card in others]
    answers = tuple(sentence for _, of in compared for sentence in of.verdict.sentences)
    return Judged(tuple(cards), (*said, *answers), (_differences(first, compared),))


def _differences(first: str, compared: Sequence[tuple[str, Comparison]]) -> TableBlock:
    columns = tuple(dict.fromkeys(each for _, of in compared for each in of.differences))
    rows = tuple(
        (name, tuple(of.differences[each].as_text(".3g") if each in of.differences else "" for each in columns))
        for name, of in compared
    )
    title = f"Differences: score minus that of {first}, with 95 % intervals that hold for all scores of a row together"
    return TableBlock(title, columns, rows)


def _measured(cards: Sequence[NamedCard]) -> tuple[TableBlock, ...]:
    judged = judge(cards)
    cards = judged.cards
    words = [{(each.metric, each.variant): each.verdict for each in _not_applicable(card)} for _, card in cards]
    scored = (column_of(score) for _, card in cards for score in card.scores)
    columns = list(dict.fromkeys([*scored, *chain.from_iterable(words)]))
    rows, notes = [], notes_on_floors(cards[0][1].scores)
    for (name, card), not_applicable in zip(cards, words, strict=True):
        cells = not_applicable | {column_of(score): _cell(score) for score in card.scores}
        rows.append((f"{name}{_BOUNDS.get(_system(name), '')}", tuple(cells.get(column, "") for column in columns)))
        missing = [each for each in card.left_out if each not in _not_applicable(card)]
        left_out = [f"left out: {each.metric} ({each.variant}): {each.why}" for each in missing]
        notes += [f"{name}: {text}" for text in (*card.deviations, *card.warnings, *left_out)]
    card = cards[0][1]
    reference_row = {
        column_of(score): score.real_against_real
        for _, of in reversed(cards)  # of the first that has it
        for score in of.scores
        if score.real_against_real
    }
    if reference_row:
        count = next(iter(reference_row.values())).num_scans
        cells = tuple(
            format_value(reference_row[column].value) if column in reference_row else "" for column in columns
        )
        rows.append((f"(real against real: halves of the reference, n = {count})", cells))
    title = (
        f"Measured, protocol {card.protocol}, {card.reference.scans_used:,} scans each, "
        f"against {card.reference.source} (sha256 {card.reference.sha256[:8]})"
    )
    return TableBlock(title, tuple(columns), tuple(rows), tuple(notes), judged.verdicts), *judged.differences


def _with_pixel_statistics(cards: Sequence[NamedCard]) -> list[NamedCard]:
    """Give every score that of the row of pixel statistics, if there is such a row."""
    rows = [card for name, card in cards if _system(name) == PIXEL_STATISTICS]
    if not rows:
        return list(cards)
    values = {column_of(score): value for score in rows[0].scores if (value := value_of_halves(score)) is not None}
    return [
        (
            name,
            replace(
                card,
                scores=tuple(
                    replace(s, pixel_statistics=values.get(column_of(s), s.pixel_statistics)) for s in card.scores
                ),
            ),
        )
        for name, card in cards
    ]


def _not_applicable(card: Scorecard) -> list[LeftOut]:
    return [each for each in card.left_out if each.verdict == NOT_APPLICABLE]


def _published(cards: Sequence[NamedCard]) -> list[TableBlock]:
    """Return the published tables of the protocol, or why they do not compare."""
    tables = [table for table in published() if table["protocol"] == cards[0][1].protocol]
    if not tables:
        return []
    why = list(dict.fromkeys(text for _, card in cards for text in card.deviations))
    if why:
        title = f"Published scores of {cards[0][1].protocol}"
        return [TableBlock(title, (), (), (f"left out, for they do not compare: {'; '.join(why)}",))]
    return [
        TableBlock(
            f"Published, not measured here: {table['title']}",
            tuple((column["metric"], column["variant"]) for column in table["columns"]),
            tuple((row["system"], _printed(row["printed"], table["columns"])) for row in table["rows"]),
            (f"source: {table['source']}", "these scores have neither an interval nor a real-against-real row"),
        )
        for table in tables
    ]


def published() -> list[dict[str, Any]]:
    """Return the published tables that this version knows: protocol, source, columns and rows as printed."""
    text = resources.files("lidargrit.evaluation").joinpath("published.json").read_text(encoding="utf-8")
    return json.loads(text)["tables"]


def _printed(values: Sequence[Any], columns: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    """Return printed scores in the metric's own unit, since papers multiply them, with no digit that was not there."""
    return tuple(
        "" if value is None else f"{value / column['divided_by']:.4g}"
        for value, column in zip(values, columns, strict=True)
    )


def _cell(score: Score) -> str:
    if score.interval is None:
        return format_value(score.result.value)
    return (
        f"{format_value(score.result.value)} [{format_value(score.interval.low)}, {format_value(score.interval.high)}]"
    )


def _grid(block: TableBlock) -> list[list[str]]:
    heads = ["system", *(f"{metric} ({variant})" for metric, variant in block.columns)]
    rows = [heads, *([name, *(cell or "-" for cell in cells)] for name, cells in block.rows)]
    return [[printable(text) for text in row] for row in rows]


def _as_text(block: TableBlock) -> str:
    lines = [printable(text) for text in (block.title, *block.verdicts)]
    if block.columns:
        grid = _grid(block)
        widths = [max(len(row[column]) for row in grid) for column in range(len(grid[0]))]
        lines += ["  ".join(t.ljust(w) for t, w in zip(row, widths, strict=True)).rstrip() for row in grid]
    return "\n".join([*lines, *map(printable, block.notes)])


def _as_markdown(block: TableBlock) -> str:
    lines = [f"**{_marked(block.title)}**", "", *(f"- {_marked(each)}" for each in block.verdicts)]
    lines += [""] if block.verdicts else []
    if block.columns:
        head, *rows = [[_marked(text) for text in row] for row in _grid(block)]
        lines += [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)] + [""]
    return "\n".join([*lines, *(f"- {_marked(note)}" for note in block.notes)]).rstrip()


def _marked(text: str) -> str:
    for sign in "\\`*_|<>[]":
        text = text.replace(sign, "\\" + sign)
    return " ".join(text.split())


def _as_latex(block: TableBlock) -> str:
    lines = [f"% {' '.join(text.split())}" for text in (block.title, *block.verdicts)]
    if block.columns:
        head, *rows = [" & ".join(_typeset(text) for text in row) + r" \\" for row in _grid(block)]
        layout = "l" + "r" * len(block.columns)
        lines += [rf"\begin{{tabular}}{{{layout}}}", r"\hline", head, r"\hline", *rows, r"\hline", r"\end{tabular}"]
    return "\n".join([*lines, *(f"% {' '.join(note.split())}" for note in block.notes)])


def _typeset(text: str) -> str:
    signs = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    signs |= {sign: "\\" + sign for sign in "&%$#_{}"}
    return " ".join("".join(signs.get(letter, letter) for letter in text).split())


_RENDERERS = {"text": _as_text, "markdown": _as_markdown, "latex": _as_latex}
