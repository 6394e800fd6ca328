"""Several systems side by side: files of scores → tables, and which system is better; published scores stand apart.

The interval of a difference comes from the same half-samples as those of the two scores: in each, both systems were
compared with the same half of the reference. The chance of the reference, which is common to both, cancels.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from itertools import chain
from pathlib import Path
from typing import Any

from lidargrit.core.errors import DataError
from lidargrit.core.files import write_json
from lidargrit.core.table import Table
from lidargrit.evaluation.intervals import Estimate, Resampling, Score, blocks, format_value, spread_of
from lidargrit.evaluation.scorecard import NOT_APPLICABLE, LeftOut, Scorecard, by_reason
from lidargrit.evaluation.verdict import (
    ENOUGH,
    MEMORISED,
    PIXEL_STATISTICS,
    Column,
    Tally,
    Verdict,
    column_of,
    names_of,
    notes_on_floors,
    too_few,
    value_of_halves,
)

NamedCard = tuple[str, Scorecard]  # name of a system, and its scores
_BOUNDS = {PIXEL_STATISTICS: " (pixel statistics)", MEMORISED: " (memorised training scans)"}
_NO_HALVES = "No verdict: without half-samples that both have in common (score both again, with the same settings)."


@dataclass(frozen=True)
class Comparison:
    """One system compared with another.

    Args:
        differences: score of the one minus that of the other, by metric and variant; the 95 % of the intervals are of
            all metrics together, so that two equal systems seldom differ in any.
        lost: metrics by which the one is worse.
    """

    differences: Mapping[Column, Estimate]
    verdict: Verdict
    lost: tuple[Column, ...] = ()


def side_by_side(paths: Sequence[Path]) -> list[Table]:
    """Set the scores of several files side by side.

    Rows share a block only if they were measured by one protocol against the very same reference. Published scores
    never stand among measured ones: they get blocks of their own, and only where the measured rows are what the
    protocol wants; else a line says why they do not compare. A file called ``marginal`` is the row of pixel statistics,
    and one called ``memorised`` that of memorised training scans.

    Args:
        paths: files that ``lidargrit evaluate --json`` wrote.
    """
    if not paths:
        raise DataError("no file of scores", "at least one", "write some with: lidargrit evaluate ... --json FILE")
    measured = comparable([(name, Scorecard.read(path)) for path, name in zip(paths, _names(paths), strict=True)])
    return [table for cards in measured for table in (*_measured(cards), *_published(cards))]


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
        differences: a table of these differences; none for a single system.
    """

    cards: tuple[NamedCard, ...]
    verdicts: tuple[str, ...]
    differences: tuple[Table, ...]


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


def _differences(first: str, compared: Sequence[tuple[str, Comparison]]) -> Table:
    known = dict.fromkeys(each for _, of in compared for each in of.differences)
    columns = tuple(sorted(known, key=lambda column: -sum(column in of.lost for _, of in compared)))
    rows = tuple(
        (name, *(of.differences[each].as_text(".3g") if each in of.differences else "" for each in columns))
        for name, of in compared
    )
    title = f"Differences: score minus that of {first}, with 95 % intervals that hold for all scores of a row together"
    return Table(_head(columns), rows, title)


def _head(columns: Iterable[Column]) -> tuple[str, ...]:
    return "system", *(f"{metric} ({variant})" for metric, variant in columns)


def _measured(cards: Sequence[NamedCard]) -> tuple[Table, ...]:
    judged = judge(cards)
    cards = judged.cards
    words = [{(each.metric, each.variant): each.verdict for each in _not_applicable(card)} for _, card in cards]
    scored = (column_of(score) for _, card in cards for score in card.scores)
    columns = list(dict.fromkeys([*scored, *chain.from_iterable(words)]))
    rows, notes = [], notes_on_floors(cards[0][1].scores)
    for (name, card), not_applicable in zip(cards, words, strict=True):
        cells = not_applicable | {column_of(score): _cell(score) for score in card.scores}
        rows.append((f"{name}{_BOUNDS.get(_system(name), '')}", *(cells.get(column, "") for column in columns)))
        missing = [each for each in card.left_out if each not in _not_applicable(card)]
        left_out = by_reason(("left out", f"{each.metric} ({each.variant})", each.why) for each in missing)
        notes += [f"{name}: {text}" for text in (*card.deviations, *card.warnings, *left_out)]
    card = cards[0][1]
    notes += card.departures
    reference_row = {
        column_of(score): score.real_against_real
        for _, of in reversed(cards)  # of the first that has it
        for score in of.scores
        if score.real_against_real
    }
    if reference_row:
        count = next(iter(reference_row.values())).num_scans
        cells = (format_value(reference_row[column].value) if column in reference_row else "" for column in columns)
        rows.append((f"(real against real: halves of the reference, n = {count})", *cells))
    title = (
        f"Measured, protocol {card.protocol}, {card.reference.scans_used:,} scans each, "
        f"against {card.reference.source} (sha256 {card.reference.sha256[:8]})"
    )
    return Table(_head(columns), tuple(rows), title, judged.verdicts, tuple(notes)), *judged.differences


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


def _published(cards: Sequence[NamedCard]) -> list[Table]:
    """Return the published tables of the protocol, or why they do not compare."""
    tables = [table for table in published() if table["protocol"] == cards[0][1].protocol]
    if not tables:
        return []
    why = list(dict.fromkeys(text for _, card in cards for text in card.deviations))
    if why:
        left_out = f"left out, for they do not compare: {'; '.join(why)}"
        return [Table(title=f"Published scores of {cards[0][1].protocol}", notes=(left_out,))]
    return [
        Table(
            _head((column["metric"], column["variant"]) for column in table["columns"]),
            tuple((row["system"], *_printed(row["printed"], table["columns"])) for row in table["rows"]),
            f"Published, not measured here: {table['title']}",
            notes=(f"source: {table['source']}", "these scores have neither an interval nor a real-against-real row"),
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


def compare_systems(name: str, card: Scorecard, other_name: str, other: Scorecard) -> Comparison:
    """Compare one system with another, both scored by one protocol against the same scans."""
    ours, theirs = ({column_of(score): score for score in each.scores} for each in (card, other))
    asked = [*ours, *theirs, *((each.metric, each.variant) for each in (*card.left_out, *other.left_out))]
    names, groups = names_of(asked), _groups_in_common(card, other)
    both = [each for each in ours if each in theirs]
    shared = [each for each in both if ours[each].result.weights_sha256 == theirs[each].result.weights_sha256]
    differences = {each: _difference(ours[each], theirs[each], groups, len(shared)) for each in shared}
    question = f"Is {name} better than {other_name}?"
    why = too_few(card.reference.scans_used) if card.reference.scans_used < ENOUGH else ""
    if why or all(math.isnan(of.low) for of in differences.values()):
        return Comparison(differences, Verdict((), (f"{question} {why or _NO_HALVES}",)))
    better, worse = (
        [
            each
            for each, of in differences.items()
            if (of.low > 0 if ours[each].result.higher_is_better is wins else of.high < 0)
        ]
        for wins in (True, False)
    )
    answer = ("In part" if worse else "Yes") if better else ("No" if worse else "Undecided")
    undecided = tuple(name for each, name in names.items() if each not in (*worse, *better))
    lost, won = (tuple(names[each] for each in some) for some in (worse, better))
    tally = Tally(f"{question} {answer}", lost, won, undecided)
    apart = ", ".join(names[each] for each in both if each not in shared)
    remarks = (f"Scored through other weights of a network, so undecided: {apart}.",) if apart else ()
    return Comparison(differences, Verdict((tally,), remarks), tuple(worse))


def _groups_in_common(card: Scorecard, other: Scorecard) -> int:
    """Return of how many groups both took the same halves; 0 if they took others."""
    ours, theirs = ((each.settings.get("resampling"), each.settings.get("seed")) for each in (card, other))
    if ours != theirs:
        return 0
    groups = ours[0].get("groups") if isinstance(ours[0], dict) else Resampling.groups
    return len(blocks(card.reference.scans_used, groups)) if isinstance(groups, int) and groups > 1 else 0


def _difference(ours: Score, theirs: Score, groups: int, together: int) -> Estimate:
    """Return one score minus another, with an interval where they have half-samples in common."""
    value = ours.result.value - theirs.result.value
    first, second = (each.interval.values if each.interval else () for each in (ours, theirs))
    if not (groups > 1 and 1 < len(first) == len(second)):
        return Estimate(value, math.nan, math.nan)
    _, reach = spread_of([one - other for one, other in zip(first, second, strict=True)], groups, together)
    return Estimate(value, value - reach, value + reach)
