"""The result of an evaluation, with everything needed to repeat it: scores → table, JSON, and back."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from lidargrit.core.configuration import hints_of, rebuilt
from lidargrit.core.errors import DataError, kind_and_words
from lidargrit.core.files import read_json, sha256_of_json
from lidargrit.core.table import Table
from lidargrit.evaluation.intervals import Score, format_value
from lidargrit.evaluation.verdict import Verdict, notes_on_floors, verdict

_OF_OTHER_FORM = {"protocol", "samples", "reference", "scores"}  # in the file
LEFT_OUT, NOT_APPLICABLE = "left out", "not applicable"
_HEAD = ("metric", "variant", "score", "95 % interval", "real against real", "pixel statistics", "better", "scans")


@dataclass(frozen=True)
class LeftOut:
    """A metric of the protocol that could not be computed.

    Args:
        verdict: words in place of the number: ``left out``, or ``not applicable`` to sets of this kind.
    """

    metric: str
    variant: str
    why: str
    verdict: str = LEFT_OUT


@dataclass(frozen=True)
class EvalSetRecord:
    """Entry of one evaluation set in a score file: what remains of the set when its images are gone.

    Args:
        data_set: name of the data set; "samples" for generated scans.
        sha256: hash of the pixels that were compared.
        weights_sha256: hash of the weights that generated the scans; "" for scans of other origins.
        streets: versions of the simulated streets that the scans are of, or that their model learned from.
        file_sha256: hash of the reference file that stood in for the scans; "" where these were here.
        labels_sha256: hash of the classes of the pixels, where ``sha256`` is without these; "" elsewhere.
    """

    source: str
    data_set: str
    split: str
    scans: int
    scans_used: int
    sensor: str
    projection: str
    sha256: str
    weights_sha256: str = field(default="", compare=False)  # equal pixels are equal
    streets: tuple[str, ...] = field(default=(), compare=False)
    file_sha256: str = field(default="", compare=False)
    labels_sha256: str = ""


@dataclass(frozen=True)
class Scorecard:
    """Result of an evaluation.

    Args:
        about: title, source, limits of range, number of scans, data set and departures of the protocol.
        samples: record of the first set, usually generated.
        reference: record of the second set, usually real.
        deviations: differences of this evaluation from the protocol.
        warnings: sentences that a reader must know before trusting a score.
        settings: settings of the evaluation, as :meth:`EvalConfig.facts` returns them.
        versions: versions of this program and of the libraries that it uses.
        leak: sentence about scans of the reference that the model learned from, or that both sets hold; "" for none.
    """

    protocol: str
    about: dict[str, Any]
    samples: EvalSetRecord
    reference: EvalSetRecord
    scores: tuple[Score, ...]
    left_out: tuple[LeftOut, ...] = ()
    deviations: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    settings: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    leak: str = ""

    @property
    def verdict(self) -> Verdict:
        """The verdict on the samples; whoever tells it tells these sentences."""
        left_out = [(each.metric, each.variant) for each in self.left_out]
        return verdict(self.scores, self.reference.scans_used, left_out, self.leak)

    @property
    def departures(self) -> list[str]:
        """A sentence for each difference of the protocol from its source, the faults that it keeps among them."""
        return [f"{self.protocol} and its source: {each}" for each in self.about.get("departures", ())]

    def to_json(self) -> dict[str, Any]:
        """Return everything as plain values, for a file, with a hash of all: :meth:`read` refuses what was altered."""
        data = {
            "protocol": {"name": self.protocol, **self.about},
            "samples": self.samples.source,
            "reference": self.reference.source,
            "inputs": {"samples": asdict(self.samples), "reference": asdict(self.reference)},
            "deviations": list(self.deviations),
            "warnings": list(self.warnings),
            "leak": self.leak,
            "verdict": list(self.verdict.sentences),
            "settings": self.settings,
            "versions": self.versions,
            "scores": [
                {
                    **asdict(score.result),
                    "interval": score.interval and asdict(score.interval),
                    "real_against_real": score.real_against_real and asdict(score.real_against_real),
                    "pixel_statistics": score.pixel_statistics,
                    "seconds": round(score.seconds, 3),
                }
                for score in self.scores
            ],
            "left_out": [asdict(each) for each in self.left_out],
        }
        return {**data, "sha256": sha256_of_json(data)}

    @classmethod
    def read(cls, path: Path) -> "Scorecard":
        """Read what :meth:`to_json` returned from a file.

        Raises:
            DataError: the file cannot be read, holds something else, or was altered.
        """
        wanted, cure = "the scores that lidargrit evaluate --json wrote", "check the path, or evaluate again"
        try:
            data = read_json(path, error=DataError, wanted=wanted, cure=cure)
            if isinstance(data, dict) and "reconstruction" in data:  # what evaluate wrote for a run
                wanted = "scores of samples, which tables set side by side"
                cure = "generate samples first with: lidargrit sample RUN FOLDER, and evaluate these"
                raise DataError(f"{path}, which holds errors of reconstruction", wanted, cure)
            card = cls.from_json(data)
            if data.pop("sha256", "") != sha256_of_json(data):
                raise DataError(f"{path}, which was altered after it was written", wanted, cure)
            return card
        except DataError:
            raise
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise DataError(f"{path}, which cannot be used ({kind_and_words(error)})", wanted, cure) from None

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> "Scorecard":
        """Return what :meth:`to_json` made plain values of; other values raise one of Python's own errors."""
        hints, protocol = hints_of(cls), dict(data["protocol"])
        rebuilt(tuple[str, ...], protocol.get("departures", []), "departures")  # refuses what is no list of sentences
        return cls(
            str(protocol.pop("name")),
            protocol,
            scores=tuple(_score(each) for each in data["scores"]),
            **{name: rebuilt(hints[name], data["inputs"][name], name) for name in ("samples", "reference")},
            **{name: rebuilt(hints[name], data[name], name) for name in hints.keys() & data.keys() - _OF_OTHER_FORM},
        )

    def as_table(self) -> str:
        """Return the scores as lines for a terminal: the verdict in words, then the numbers."""
        rows = [_row(score) for score in self.scores]
        rows += [(each.metric, each.variant or "-", each.verdict, *[""] * 5) for each in self.left_out]
        notes = notes_on_floors(self.scores)
        notes += by_reason((each.verdict, each.metric, each.why) for each in self.left_out)
        notes += [f"not the protocol {self.protocol}: {each}" for each in self.deviations]
        notes += self.departures
        versions = sorted({*self.samples.streets, *self.reference.streets})
        notes += [f"simulated streets: {', '.join(versions)}"] * bool(versions)
        table = Table(_HEAD, tuple(rows), sentences=(*self.verdict.sentences, ""), notes=tuple(notes))
        return table.without_empty("pixel statistics").as_text()


def by_reason(missing: Iterable[tuple[str, str, str]]) -> list[str]:
    """Return a sentence for each reason, with all that are missing for it.

    Args:
        missing: triples of the words in place of a number, a metric, and the reason.
    """
    names: dict[tuple[str, str], list[str]] = {}
    for words, name, why in missing:
        names.setdefault((words, why), []).append(name)
    return [f"{words}: {', '.join(some)}: {why}" for (words, why), some in names.items()]


def _row(score: Score) -> tuple[str, ...]:
    result, interval, real = score.result, score.interval, score.real_against_real
    return (
        result.metric,
        result.variant,
        format_value(result.value),
        f"{format_value(interval.low)} .. {format_value(interval.high)}" if interval else "",
        f"{format_value(real.value)} (n={real.num_scans})" if real else "",
        "" if score.pixel_statistics is None else format_value(score.pixel_statistics),
        "higher" if result.higher_is_better else "lower",
        f"{result.num_generated} v {result.num_reference}",
    )


def _score(data: dict[str, Any]) -> Score:
    beside = {name: data[name] for name in hints_of(Score) if name != "result"}
    result = {name: value for name, value in data.items() if name not in beside}
    return rebuilt(Score, {"result": result, **beside})
