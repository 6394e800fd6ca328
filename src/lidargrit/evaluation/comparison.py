"""Samples and a reference, by a protocol: two sources → a scorecard."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

from lidargrit import __version__, _discovery
from lidargrit.errors import ConfigError, LidarGritError, ScanError, nearest_names
from lidargrit.evaluation.intervals import Part, Resampling, blocks, interval_of, merged, real_against_real
from lidargrit.evaluation.pairs import EvalPair, EvalSet, pair_for_protocol
from lidargrit.evaluation.protocols import DEFAULT, MetricChoice, Protocol, load_protocol, public_name
from lidargrit.evaluation.scorecard import LeftOut, Score, Scorecard
from lidargrit.loading import DataConfig
from lidargrit.metrics import Metric, load_metric
from lidargrit.projection import Variant
from lidargrit.reporting import Reporter

_BATCH = 16
_FEW = 100  # scans: below that the interval itself rests on too little, and values hardly differ from real against real
_ORDER_MATTERS = frozenset({"sliced_wasserstein"})  # its program draws patches batch by batch: parts draw others


@dataclass(frozen=True)
class EvalConfig:
    """How two sets are compared.

    Args:
        protocol: its name.
        metrics: names, in place of the protocol's; of those that it has the protocol's definitions are kept.
        variant: one definition for all metrics, in place of the protocol's.
        projection_variant: of real scans, in place of the protocol's.
        max_scans: of each set at most; 0 for the protocol's.
        seed: of whatever a metric draws.
        resampling: how intervals and real against real are computed.
        weights: files by the name of their network.
        samples_format: the sample_format of a folder of tensors.
        device: where networks compute.
        data: how scans are read.
    """

    protocol: str = DEFAULT
    metrics: tuple[str, ...] = ()
    variant: str = ""
    projection_variant: Variant | None = None
    max_scans: int = 0
    seed: int = 0
    resampling: Resampling = field(default_factory=Resampling)
    weights: Mapping[str, Path] = field(default_factory=dict)
    samples_format: str = ""
    device: str = "cpu"
    data: DataConfig = field(default_factory=DataConfig)

    def __post_init__(self) -> None:
        if self.max_scans < 0 or self.seed < 0:
            raise ConfigError(f"-n {self.max_scans}, --seed {self.seed}", "0 or more", "correct the number")

    def facts(self) -> dict[str, Any]:
        """Return what the scorecard tells of them, as plain values."""
        return {
            "metrics": list(self.metrics),
            "variant": self.variant,
            "projection_variant": self.projection_variant or load_protocol(self.protocol).variant,
            "max_scans": self.max_scans,
            "seed": self.seed,
            "resampling": asdict(self.resampling),
            "weights": {name: str(path) for name, path in self.weights.items()},
            "samples_format": self.samples_format,
            "bad_points": self.data.bad_points,
            "bad_scans": self.data.bad_scans,
        }


def compare_sources(
    samples: str, reference: str, settings: EvalConfig | None = None, reporter: Reporter | None = None
) -> tuple[Scorecard, EvalPair]:
    """Score a folder of samples, or any source of scans, against another.

    Args:
        samples: a folder of samples, of ours or of another program, or a source of scans.
        reference: likewise; scans are projected with the sensor of the samples.
        settings: the protocol and more.
        reporter: hears of progress and warnings.

    Raises:
        ConfigError: the two sets look along different rays, or a setting is out of its bounds.
        UnknownNameError: no such protocol or metric.
        LidarGritError: not one metric could be computed; what the first said.
    """
    settings, reporter = settings or EvalConfig(), reporter or Reporter()
    pair = open_pair(samples, reference, settings, reporter)
    return compare_pair(pair, settings, reporter), pair


def open_pair(samples: str, reference: str, settings: EvalConfig, reporter: Reporter) -> EvalPair:
    """Open the two sets of :func:`compare_sources`, and say what there is to say against comparing them."""
    protocol = load_protocol(settings.protocol)
    chosen_metrics(protocol, settings)  # refuses unknown names before scans are projected
    variant = settings.projection_variant or protocol.variant
    config = replace(settings.data, projection_variant=variant, max_scans=settings.max_scans)
    pair = pair_for_protocol(samples, reference, protocol, config, settings.samples_format, reporter)
    for warning in pair.warnings:
        reporter.message(f"WARNING: {warning}")
    return pair


def compare_pair(pair: EvalPair, settings: EvalConfig, reporter: Reporter | None = None) -> Scorecard:
    """Score two opened sets, one metric after the other, so that only one's memory is held."""
    reporter, protocol = reporter or Reporter(), load_protocol(settings.protocol)
    scores: list[Score] = []
    left_out: list[LeftOut] = []
    errors: list[LidarGritError] = []
    wanted = chosen_metrics(protocol, settings)
    with reporter.progress("scoring", 2 * len(pair.samples) * len(wanted)) as progress:
        for choice in wanted:
            heard = partial(progress.advance, note=choice.metric)
            try:
                scores.append(_score(choice, pair, settings, reporter, heard))
            except ScanError:  # a damaged file, which spoils all metrics alike
                raise
            except LidarGritError as error:  # no weights, no reflectance, too few scans: the others may do without
                errors.append(error)
                left_out.append(LeftOut(choice.metric, choice.variant, str(error)))
    if errors and not scores:
        raise errors[0]
    warnings = [*pair.warnings, *_doubts(pair, scores, settings.resampling)]
    return Scorecard(
        public_name(settings.protocol),
        {
            "title": protocol.title,
            "source": protocol.source,
            "range_m": protocol.range_m,
            "num_scans": protocol.num_scans,
            "data_set": protocol.data_set,
            "departures": list(protocol.departures),
        },
        pair.samples.facts(),
        pair.reference.facts(),
        tuple(scores),
        tuple(left_out),
        pair.deviations,
        tuple(warnings),
        settings.facts(),
        {
            "lidargrit": __version__,
            "python": platform.python_version(),
            **{name: metadata.version(name) for name in ("torch", "numpy", "scipy")},
        },
    )


def chosen_metrics(protocol: Protocol, settings: EvalConfig) -> list[MetricChoice]:
    """Return what is to be computed: the protocol's numbers, or those of the metrics that the user named.

    Raises:
        UnknownNameError: a metric that the user named and nobody has.
        ConfigError: a variant that none of the metrics has.
    """
    wanted = list(protocol.metrics)
    if settings.metrics:
        wanted = []
        for name in map(public_name, settings.metrics):
            cls = load_metric(name)
            its_own = [choice for choice in protocol.metrics if choice.metric == name]
            # Of the default protocol all definitions are shown: whoever asks for one metric wants to see them.
            every = [MetricChoice(name, variant) for variant in cls.variants]
            wanted += every if public_name(settings.protocol) == DEFAULT or not its_own else its_own
    if settings.variant:
        _require_known(settings.variant, wanted)
        wanted = [replace(choice, variant=settings.variant) for choice in wanted]
    kept: list[MetricChoice] = []
    for choice in wanted:
        if choice not in kept:
            kept.append(choice)
    return kept


def _require_known(variant: str, wanted: Sequence[MetricChoice]) -> None:
    """Refuse a variant that no wanted metric has; where some have it, the others are left out and say so."""
    known = {name for choice in wanted for name in load_metric(choice.metric).variants}
    if variant not in known:
        raise ConfigError(f"variant {variant!r}", f"one such as {nearest_names(variant, known)}", "choose one of these")


def _score(
    choice: MetricChoice, pair: EvalPair, settings: EvalConfig, reporter: Reporter, heard: Callable[[int], None]
) -> Score:
    """Compute one number with its interval and its reference row."""
    begun, resampling = time.perf_counter(), settings.resampling
    make, options = _maker(choice, settings, reporter)
    make()  # a variant that it does not have, or weights that are not there, are told before scans are read
    groups = blocks(len(pair.samples), resampling.groups if resampling.halves else 1)
    generated = [Part(_fed(make(), pair.samples, group, heard)) for group in groups]
    real, real_as_generated = [], []
    for group in groups:
        metric, again = make(), make() if resampling.halves else None
        _fed(metric, pair.reference, group, heard, real=True, also_as_generated=again)
        real.append(Part(metric))
        real_as_generated += [] if again is None else [Part(again)]
    if choice.metric in _ORDER_MATTERS and len(groups) > 1:
        whole = make()
        _fed(whole, pair.samples, range(len(pair.samples)))
        _fed(whole, pair.reference, range(len(pair.reference)), real=True)
        result = whole.compute()
        del whole
    else:
        result = merged(generated, real).compute()
    interval = reference_row = None
    if resampling.halves:
        interval = interval_of(result, generated, real, resampling)
        reference_row = real_against_real(real, real_as_generated, [len(group) for group in groups], resampling)
    return Score(result, interval, reference_row, options, time.perf_counter() - begun)


def _maker(
    choice: MetricChoice, settings: EvalConfig, reporter: Reporter
) -> tuple[Callable[[], Metric], dict[str, Any]]:
    """Return what makes an empty metric, and its options as they are told."""
    if choice.metric not in _discovery.names("metrics"):
        raise ConfigError(f"the metric {choice.metric!r}", "one that this version has", "see: lidargrit list metrics")
    cls = load_metric(choice.metric)
    options: dict[str, Any] = dict(choice.options)
    needs: dict[str, Any] = {}
    if cls.needs_weights:
        needs = {"weights": settings.weights.get(cls.needs_weights), "device": settings.device, "reporter": reporter}
    return partial(cls, variant=choice.variant or None, seed=settings.seed, **options, **needs), options


def _fed(
    metric: Metric,
    side: EvalSet,
    places: Sequence[int],
    heard: Callable[[int], None] | None = None,
    *,
    real: bool = False,
    also_as_generated: Metric | None = None,
) -> Metric:
    """Feed images to a metric, perhaps at once to another as if they were generated, and return the first."""
    for first in range(0, len(places), _BATCH):
        images = side.batch(places[first : first + _BATCH])
        metric.update(images, real=real)
        if also_as_generated is not None:
            also_as_generated.update(images, real=False)
        if heard is not None:
            heard(len(images))
    return metric


def _doubts(pair: EvalPair, scores: Sequence[Score], resampling: Resampling) -> list[str]:
    """Return what is to be said against the numbers themselves."""
    found = []
    count = len(pair.samples)
    if count < _FEW:
        found.append(f"{count} scans of each set: too few to tell from real against real, and intervals rest on little")
    if resampling.halves and any(score.interval is None for score in scores):
        without = [score.result.metric for score in scores if score.interval is None]
        found.append(f"too few scans for the intervals of {', '.join(dict.fromkeys(without))}")
    for score in scores:
        name = f"{score.result.metric} ({score.result.variant})"
        told = score.result.details.get("warnings", [])
        found += [f"{name}: {text}" for text in told]
    return found
