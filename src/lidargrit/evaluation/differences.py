"""Two systems scored alike against the same scans → how far their scores differ, with intervals, and which is better.

The interval of a difference comes from the same half-samples as those of the two scores: in each, both systems were
compared with the same half of the reference. The chance of the reference, which is common to both, cancels.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from lidargrit.evaluation.estimates import Estimate
from lidargrit.evaluation.intervals import Resampling, Score, blocks, spread_of
from lidargrit.evaluation.scorecard import Scorecard
from lidargrit.evaluation.verdict import ENOUGH, Column, Tally, Verdict, column_of, names_of, too_few

_NO_HALVES = "No verdict: without half-samples that both have in common (score both again, with the same settings)."


@dataclass(frozen=True)
class Comparison:
    """One system compared with another.

    Args:
        differences: score of the one minus that of the other, by metric and variant; the 95 % of the intervals are of
            all metrics together, so that two equal systems seldom differ in any.
        verdict: answer in words.
    """

    differences: Mapping[Column, Estimate]
    verdict: Verdict


def compare_systems(name: str, card: Scorecard, other_name: str, other: Scorecard) -> Comparison:
    """Compare one system with another, both scored by one protocol against the same scans."""
    ours, theirs = ({column_of(score): score for score in each.scores} for each in (card, other))
    asked = [*ours, *theirs, *((each.metric, each.variant) for each in (*card.left_out, *other.left_out))]
    names, groups = names_of(asked), _groups_in_common(card, other)
    shared = [each for each in ours if each in theirs]
    differences = {each: _difference(ours[each], theirs[each], groups, len(shared)) for each in shared}
    question = f"Is {name} better than {other_name}?"
    why = too_few(card.reference.scans_used) if card.reference.scans_used < ENOUGH else ""
    if why or all(math.isnan(of.low) for of in differences.values()):
        return Comparison(differences, Verdict((), (f"{question} {why or _NO_HALVES}",)))
    better, worse = (
        [
            names[each]
            for each, of in differences.items()
            if (of.low > 0 if ours[each].result.higher_is_better is wins else of.high < 0)
        ]
        for wins in (True, False)
    )
    answer = ("In part" if worse else "Yes") if better else ("No" if worse else "Undecided")
    undecided = tuple(one for one in names.values() if one not in (*worse, *better))
    tally = Tally(f"{question} {answer}", tuple(worse), tuple(better), undecided)
    return Comparison(differences, Verdict((tally,), ()))


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
