"""Scores between their reference rows → the one verdict, which terminals, pages, cards and the demo print as it is.

Every score table of this program knows three bounds, by these names alone:

- *real against real*: one half of the real scans, scored as if it had been generated, against the other half. Between
  as many scans, no generator can be expected to do better.
- *pixel statistics*: scans each of whose pixels comes from another real scan, or scans of the generator ``marginal``,
  which samples every pixel by itself. A model must do better.
- *memorised training scans*: scans of the generator ``memorised``. They score like real scans, and nothing is new.

Metrics of what stands in scans are named first, and the number of objects a scan stands before all counts.

A score counts as lost wherever its metric sees a difference. It counts as won only where the metric tells pixel
statistics from real scans: of one that does not, a good score says little. It is called within noise only where the
metric would have seen known damages of objects, with as many scans (:func:`.blind_to`).
"""

import csv
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Final

from lidargrit.core import discovery
from lidargrit.core.errors import counted_scans
from lidargrit.evaluation.intervals import Score, format_value
from lidargrit.evaluation.metrics import load_metric

Column = tuple[str, str]  # metric, variant

PIXEL_STATISTICS, MEMORISED = "marginal", "memorised"
"""The generators whose scans may stand for the second bound, and are the third."""

ENOUGH = 100
"""Scans of each set: below, the interval itself rests on too little, and hardly any score differs from its bounds."""

_NOTHING_KNOWN = "No verdict: it takes intervals, and real against real or pixel statistics beside them."
_WITHOUT_PIXELS = (
    "Pixel statistics, which any model has to beat, were not scored, so that no good score is counted (evaluate "
    "--pixel-statistics; marginal beside other systems)."
)
DEVIATIONS: Final = 2.8
"""Standard deviations beyond which a difference is no chance: Student's 97.5 % quantile for five halvings."""

_TABLE = "sight.csv"


@dataclass(frozen=True)
class Tally:
    """All scores that were asked for, by how they stand to one bound or to those of another system.

    Args:
        head: beginning of the sentence, which names what they are compared with.
        worse: names of the scores that are worse by more than chance.
        better: names of those that are better by more than chance, or as ``praise`` says.
        undecided: names of all others.
        praise: word for ``better``, which real scans hardly are.
    """

    head: str
    worse: tuple[str, ...]
    better: tuple[str, ...]
    undecided: tuple[str, ...]
    praise: str = "better"

    def __str__(self) -> str:
        total = len(self.worse) + len(self.better) + len(self.undecided)
        counts = (
            (f"worse in {len(self.worse)} of {total} scores", self.worse),
            (f"{self.praise} in {len(self.better)}", self.better),
            (f"undecided in {len(self.undecided)}", self.undecided),
        )
        some = range(1, max(total, 2))  # of a group that is all, nobody needs the names
        said = (f"{count} ({', '.join(names)})" if len(names) in some else count for count, names in counts)
        return f"{self.head}: {', '.join(said)}."


@dataclass(frozen=True)
class Verdict:
    """What is said of the scores of one system.

    Args:
        tallies: counts against each bound that is known; none where there is no verdict.
        remarks: sentences that belong to them, or say why there are none.
        objects: sentence on the number of objects a scan; "" where they were not counted.
    """

    tallies: tuple[Tally, ...]
    remarks: tuple[str, ...]
    objects: str = ""

    @property
    def sentences(self) -> tuple[str, ...]:
        """All that is said, objects and losses first."""
        return (*filter(None, [self.objects]), *map(str, self.tallies), *self.remarks)


def verdict(scores: Sequence[Score], scans: int, left_out: Sequence[Column] = (), leak: str = "") -> Verdict:
    """Return how the scores of one set of samples stand to pixel statistics and to real against real.

    Args:
        scores: scores with their reference rows, where these are known.
        scans: number of scans of each set.
        left_out: metrics that were asked for and could not be scored, which are undecided.
        leak: sentence about scans of the reference that the model learned from, or that both sets hold; "" for none.
    """
    scores = sorted(scores, key=lambda score: not _sees_objects(score))
    names, objects = names_of([*map(column_of, scores), *left_out]), objects_a_scan(scores)
    said = [f"{leak}."] if leak else []
    if below := [names[column_of(score)] for score in scores if score.result.value < 0]:
        said.append(
            f"{', '.join(below)} below 0: the unbiased estimate of a squared distance scatters around 0 for sets that "
            "do not differ; read it as 0."
        )
    if scans < ENOUGH:
        return Verdict((), (too_few(scans), *said), objects)
    by_pixels = {column_of(score): _standing(score, score.pixel_statistics) for score in scores}
    by_real = {
        column_of(score): _standing(score, real.value if (real := score.real_against_real) else None)
        for score in scores
    }
    seeing = {column_of(score) for score in scores if tells_apart(score)}
    tallies = []
    if known_pixels := any(stands is not None for stands in by_pixels.values()):
        tallies.append(_tally("Against pixel statistics", by_pixels, (-1,), seeing, names))
    sharp = {column for column in seeing if blind_to(*column, scans) == ()}
    if any(stands is not None for stands in by_real.values()):
        tallies.append(_tally("Against real scans", by_real, (0, -1), sharp, names, "within noise"))
    if not tallies:
        return Verdict((), (_NOTHING_KNOWN, *said), objects)
    notes = [] if known_pixels else [_WITHOUT_PIXELS]
    if blind := [names[column_of(score)] for score in scores if tells_apart(score) is False]:
        notes.append(f"Pixel statistics pass for real scans in {', '.join(blind)}: no good score there is counted.")
    if dull := [names[each] for each, stands in by_real.items() if stands in (0, -1) and each in seeing - sharp]:
        notes.append(
            f"With {counted_scans(scans)}, {', '.join(dull)} cannot see at least one of these: blurred ranges, missing "
            "vehicles, boxes in place of vehicles. So a good score there is not called within noise."
        )
    if left_out:
        notes.append(f"Not scored, so undecided: {', '.join(map(names.__getitem__, left_out))}.")
    if beyond := [names[each] for each, stands in by_real.items() if stands == -1 and each in seeing]:
        notes.append(
            f"Better than real against real: {', '.join(beyond)}. Either the samples repeat scans of the reference, or "
            "they vary less than real ones."
        )
    return Verdict(tuple(tallies), (*notes, *said), objects)


def objects_a_scan(scores: Sequence[Score]) -> str:
    """Return a sentence on the number of objects a scan in both sets; "" where no score counted them."""
    for score in scores:
        made, real = (score.result.details.get(name) for name in ("generated", "real"))
        if score.result.metric == "object_statistics" and made and real:
            number = "number_a_scan"
            each = (f"{kind} {made[kind][number]:.1f} v {real[kind][number]:.1f}" for kind in real)
            return f"Objects a scan, samples v reference: {', '.join(each)}."
    return ""


def _sees_objects(score: Score) -> bool:
    return score.result.metric in discovery.names("metrics") and load_metric(score.result.metric).sees_objects


def too_few(scans: int) -> str:
    """Return the sentence that stands in place of a verdict on few scans."""
    return (
        f"No verdict: {counted_scans(scans)} in each set are too few for reliable scores and intervals, which take "
        f"{ENOUGH} or more."
    )


def column_of(score: Score) -> Column:
    """Return the metric and the variant of a score."""
    return score.result.metric, score.result.variant


def names_of(columns: Sequence[Column]) -> dict[Column, str]:
    """Return the names of metrics, each with its variant where several variants of it stand side by side."""
    metrics = [metric for metric, _ in dict.fromkeys(columns)]
    return {
        (metric, variant): metric if metrics.count(metric) == 1 else f"{metric} ({variant})"
        for metric, variant in columns
    }


def noise(score: Score) -> float:
    """Return half the width of a score's interval, 0 without one."""
    if score.interval is None:
        return 0.0
    return max(score.interval.high - score.result.value, score.result.value - score.interval.low)


def value_of_halves(score: Score) -> float | None:
    """Return the mean score of halves of both sets, since most metrics are worse for fewer scans; None if not known."""
    return None if score.interval is None else score.interval.mean_of_halves


def tells_apart(score: Score) -> bool | None:
    """Return whether the metric separates pixel statistics from real scans by more than chance; None if not known.

    Chance is that of real against real, since the model's own noise must not decide which scores count; that noise
    stands in where it is not known.
    """
    real = score.real_against_real
    if score.pixel_statistics is None or real is None:
        return None
    chance = noise(score) if real.spread is None else DEVIATIONS * real.spread
    return _worse_by(score, score.pixel_statistics, real.value) > chance


def _tally(
    head: str,
    stands: Mapping[Column, int | None],
    praised: Container[int | None],
    seeing: Container[Column],
    names: Mapping[Column, str],
    praise: str = "better",
) -> Tally:
    worse = tuple(name for each, name in names.items() if stands.get(each) == 1)
    better = tuple(name for each, name in names.items() if each in seeing and stands.get(each) in praised)
    return Tally(head, worse, better, tuple(name for name in names.values() if name not in (*worse, *better)), praise)


def _standing(score: Score, bound: float | None) -> int | None:
    """Return 1 if a score is worse than a bound by more than chance, -1 if better, else 0; None if it is not known."""
    if bound is None or (value := value_of_halves(score)) is None:
        return None
    by = _worse_by(score, value, bound)
    return int(by > noise(score)) - int(-by > noise(score))


def _worse_by(score: Score, value: float, other: float) -> float:
    """Return by how much one value of a metric is worse than another one of the same metric."""
    return other - value if score.result.higher_is_better else value - other


def notes_on_floors(scores: Sequence[Score]) -> list[str]:
    """Return a note for each metric by which equal sets do not score 0, with its score of real against real."""
    notes = []
    for score in scores:
        metric, variant = column_of(score)
        if metric in discovery.names("metrics") and (why := load_metric(metric).of_equal_sets.get(variant)):
            real = score.real_against_real
            floor = f"{format_value(real.value)} between {counted_scans(real.num_scans)}" if real else "not known here"
            notes.append(
                f"{metric} ({variant}) is not 0 for equal sets: {why}; its floor, real against real, is {floor}"
            )
    return notes


def blind_to(metric: str, variant: str, scans: int) -> tuple[str, ...] | None:
    """Return the damages that a metric would not have seen; None for a metric that was not measured.

    The damages are ranges blurred over three columns, every second vehicle removed, and boxes in place of vehicles; of
    streets of 64x256. What was seen with fewer scans is seen with more.

    Args:
        scans: number of scans of each set.
    """
    damages = _measured().get((metric, variant))
    if damages is None:
        return None
    return tuple(name for name, fewest in damages.items() if fewest is None or fewest > scans)


@cache
def _measured() -> dict[tuple[str, str], dict[str, int | None]]:
    """Return for each metric and variant the fewest scans with which each damage was seen; None if with none."""
    found: dict[tuple[str, str], dict[str, int | None]] = {}
    for row in sorted(_rows(), key=lambda row: int(row["scans"])):
        damages = found.setdefault((row["metric"], row["variant"]), {})
        if damages.setdefault(row["damage"], None) is None and float(row["deviations"]) > DEVIATIONS:
            damages[row["damage"]] = int(row["scans"])
    return found


def _rows() -> Iterator[dict[str, str]]:
    text = resources.files("lidargrit.evaluation").joinpath(_TABLE).read_text(encoding="utf-8")
    yield from csv.DictReader(text.splitlines())
