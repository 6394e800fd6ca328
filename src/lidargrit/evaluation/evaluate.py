"""Samples and a reference, by a protocol: two sources → a scorecard."""

import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache, partial
from importlib import metadata
from pathlib import Path
from typing import Any

from lidargrit.core import discovery, reporting
from lidargrit.core.errors import ConfigError, LidarGritError, nearest_names, one_of
from lidargrit.core.shares import connected
from lidargrit.core.untrusted import COUNT_AT_MOST, SEED_AT_MOST
from lidargrit.core.version import __version__, source_sha256
from lidargrit.data.prepared.config import NOTHING_NAMED, DataConfig, ScanSettings
from lidargrit.data.sources import RunSource, Source, open_source
from lidargrit.evaluation.intervals import Resampling, Score
from lidargrit.evaluation.metrics import load_metric
from lidargrit.evaluation.pairs import EvalPair, Opened, pair_for_protocol
from lidargrit.evaluation.protocols import DEFAULT, MetricChoice, Protocol, load_protocol, public_name
from lidargrit.evaluation.reference_file import FiledSet, ReferenceFile, reference_file, write_reference
from lidargrit.evaluation.scorecard import NOT_APPLICABLE, LeftOut, Scorecard
from lidargrit.evaluation.scoring import Cluster, MetricFactory, keep_real, score_metrics
from lidargrit.nn.devices import usable_device
from lidargrit.scans.projection import ProjectionVariant
from lidargrit.scans.sensors import SensorModel, load_sensor


@dataclass(frozen=True)
class EvalConfig:
    """How two sets are compared.

    Args:
        metrics: names of metrics, in place of the protocol's; metrics of the protocol keep its definitions.
        variant: one definition for all metrics, in place of the protocol's.
        sensor: name or ``.json`` file of the sensor that scans are imaged with, in place of the protocol's.
        projection_variant: variant by which real scans become images, in place of the protocol's.
        max_scans: largest number of scans of each set; 0 for the protocol's.
        seed: seed of the random numbers that metrics use.
        resampling: settings of the intervals and of real against real.
        weights: files of published weights, by the name of their network.
        pixel_statistics: whether every score gets that of pixel statistics of the reference beside it.
        samples_format: name of the program that wrote a folder of tensors; recognised from the first file if empty.
        device: name of the device that networks compute on.
    """

    protocol: str = DEFAULT
    metrics: tuple[str, ...] = ()
    variant: str = ""
    sensor: str = ""
    projection_variant: ProjectionVariant | None = None
    max_scans: int = 0
    seed: int = 0
    resampling: Resampling = field(default_factory=Resampling)
    weights: Mapping[str, Path] = field(default_factory=dict, hash=False)
    pixel_statistics: bool = False
    samples_format: str = ""
    device: str = "cpu"
    data: DataConfig = field(default_factory=DataConfig)

    def __post_init__(self) -> None:
        if not (0 <= self.max_scans <= COUNT_AT_MOST and 0 <= self.seed <= SEED_AT_MOST):
            raise ConfigError(
                f"-n {str(self.max_scans)[:25]}, --seed {str(self.seed)[:25]}",
                f"at most {COUNT_AT_MOST:,} scans, and a seed from 0 to 2^32 - 1",
                "correct the number",
            )
        if self.pixel_statistics and not self.resampling.halves:
            raise ConfigError(
                "--pixel-statistics with --intervals 0",
                "intervals: pixel statistics stand beside the halves that they are taken from",
                "leave one of the two out",
            )
        self.chosen_metrics()  # refuses unknown names before anything is opened

    def chosen_metrics(self) -> list[MetricChoice]:
        """Return the metrics to compute: the protocol's, or those that the user named.

        Raises:
            UnknownNameError: no such protocol, or the user named a metric that does not exist.
            ConfigError: none of the metrics has the variant that the user named.
        """
        protocol = load_protocol(self.protocol)
        wanted = list(protocol.metrics)
        if self.metrics:
            wanted = []
            for name in map(public_name, self.metrics):
                cls = load_metric(name)
                its_own = [choice for choice in protocol.metrics if choice.metric == name]
                # Of the default protocol all definitions are shown: whoever asks for one metric wants to see them.
                every = [MetricChoice(name, variant) for variant in cls.variants]
                wanted += every if public_name(self.protocol) == DEFAULT or not its_own else its_own
        if self.variant:
            known = {name for choice in wanted for name in load_metric(choice.metric).variants}
            if self.variant not in known:  # where some have it, the others are left out and say so
                such = f"one such as {nearest_names(self.variant, known)}"
                raise ConfigError(f"variant {self.variant!r}", such, "choose one of these")
            wanted = [replace(choice, variant=self.variant) for choice in wanted]
        return list(dict.fromkeys(wanted))

    def data_config(self) -> DataConfig:
        """Return the settings by which scans of either set are read and projected, as the protocol or the user says."""
        protocol = load_protocol(self.protocol)
        variant = self.projection_variant or protocol.variant
        return replace(self.data, projection_variant=variant, max_scans=protocol.scans_at_most(self.max_scans))

    def facts(self) -> dict[str, Any]:
        """Return the entries of a scorecard, as plain values."""
        return {
            "metrics": list(self.metrics),
            "variant": self.variant,
            "projection_variant": self.data_config().projection_variant,
            **({"sensor": self.sensor} if self.sensor else {}),
            **({"projection": self.data.projection} if self.data.projection != "sensor" else {}),
            **({"columns": self.data.columns, "column_stride": self.data.column_stride} if self.data.columns else {}),
            "max_scans": self.max_scans,
            "seed": self.seed,
            "resampling": asdict(self.resampling),
            "weights": {name: str(path) for name, path in self.weights.items()},
            "samples_format": self.samples_format,
            "bad_points": self.data.bad_points,
            "bad_scans": self.data.bad_scans,
        }


def read_config(
    scans: ScanSettings = NOTHING_NAMED,
    *,
    metrics: Sequence[str] = (),
    weights: Sequence[str] = (),
    groups: int = 16,
    intervals: int = 20,
    **settings: Any,
) -> EvalConfig:
    """Turn words and numbers, as a user types them, into a configuration.

    Args:
        weights: words such as ``pointnet=FILE``.
    """
    settings["max_scans"] = settings.get("max_scans") or scans.data.max_scans
    return EvalConfig(
        metrics=tuple(metrics),
        resampling=Resampling(groups, intervals, max(settings.get("seed", 0), 0)),
        weights=_weights(weights),
        sensor=scans.sensor,
        projection_variant=scans.projection_variant,
        data=scans.data,
        **settings,
    )


def _weights(words: Sequence[str]) -> dict[str, Path]:
    """Turn words such as ``pointnet=FILE`` into files by the name of their network."""
    if not words:
        return {}
    known = {load_metric(name).needs_weights for name in discovery.names("metrics")} - {""}
    files = {}
    for word in words:
        name, equals, path = word.partition("=")
        if not (equals and path) or name not in known:
            wanted = f"NAME=FILE with {nearest_names(name, known)} for NAME"
            raise ConfigError(f"--weights {word}", wanted, "name a network and the file with its weights")
        files[name] = Path(path)
    return files


def evaluate_sources(
    samples: str, reference: str, settings: EvalConfig | None = None, ray: str = ""
) -> tuple[Scorecard, EvalPair]:
    """Score a folder of samples, or any source of scans, against another.

    Args:
        samples: name of a folder of samples, of ours or of another program, or of any source of scans.
        reference: name of the second set; its scans are projected with the sensor of the samples.
        settings: protocol and its changes.
        ray: address of a Ray cluster that feeds the metrics; see :func:`each_done`.

    Raises:
        ConfigError: the two sets look along different rays, or a setting is out of its bounds.
        UnknownNameError: no such protocol or metric.
        LidarGritError: not one metric could be computed; what the first said.
    """
    settings = settings or EvalConfig()
    if not (samples and reference):
        got = f"{samples!r} alone" if samples else "nothing to score"
        raise ConfigError(got, "samples and what they are compared with", "name two sets")
    usable_device(settings.device)
    first = open_source(samples, settings.data.bad_points, settings.samples_format)
    second = open_reference(reference, settings)
    if isinstance(first, RunSource):
        raise ConfigError(
            f"the run {samples}, which holds no scans",
            "its samples, or scans to measure under it",
            f"lidargrit sample {samples} FOLDER, or lidargrit likelihood {reference} --model {samples}",
        )
    _refuse_unused(first, settings)
    pair = open_pair(first, second, settings)
    with connected(ray):
        there = Cluster(ray, partial(_pair_of, samples, reference, settings), settings.device != "cpu")
        card = evaluate_pair(pair, settings, there if ray else None)
    for warning in card.warnings[len(pair.warnings) :]:
        reporting.message(f"WARNING: {warning}")
    return card, pair


@lru_cache(maxsize=1)  # for all groups that a worker feeds
def _pair_of(samples: str, reference: str, settings: EvalConfig) -> EvalPair:
    first = open_source(samples, settings.data.bad_points, settings.samples_format)
    with reporting.to(reporting.Reporter()):  # the command has told all warnings
        return open_pair(first, open_reference(reference, settings), settings)


def open_reference(text: str, settings: EvalConfig) -> Source | ReferenceFile:
    """Open a reference: a source of scans, or the file of what metrics keep of one."""
    return reference_file(text) or open_source(text, settings.data.bad_points)


def open_pair(samples: Source, reference: Source | ReferenceFile, settings: EvalConfig) -> EvalPair:
    """Read the two sets of an evaluation, and warn where they are not comparable."""
    protocol, config = load_protocol(settings.protocol), settings.data_config()
    if isinstance(reference, ReferenceFile):
        named = public_name(settings.protocol)
        reference.require(named, protocol.sha256, settings.resampling, settings.seed, settings.pixel_statistics)
        pair, told = reference.pair_with(samples, protocol, config), samples.doubts
    else:
        pair = pair_for_protocol(samples, reference, protocol, config, _sensor(samples, settings))
        told = (*samples.doubts, *reference.doubts)
    for warning in filter(None, (*pair.warnings, pair.leak)):
        if warning not in told:  # when the scans were opened
            reporting.message(f"WARNING: {warning}")
    return pair


def _sensor(scans: Source, settings: EvalConfig) -> SensorModel | None:
    """Return the sensor of the images that the user or the protocol names; None for the scans' own."""
    config = settings.data_config()
    sensor = load_sensor(settings.sensor) if settings.sensor else load_protocol(settings.protocol).load_sensor()
    if sensor is None and (settings.data.columns or settings.data.projection != "sensor"):
        sensor = scans.sensor  # named for prepared scans and .npy, which else keep their own columns and projection
    return sensor and config.with_projection(sensor)


def save_reference(scans: str, path: Path, settings: EvalConfig) -> ReferenceFile:
    """Write all that metrics keep of real scans into a file, by which others score samples without these scans.

    The file holds no scan. Metrics that the user named are kept at any size, those of the protocol up to a limit.
    """
    usable_device(settings.device)
    protocol, config = load_protocol(settings.protocol), settings.data_config()
    source = open_source(scans, settings.data.bad_points)
    opened = Opened.of(source, _sensor(source, settings), config)
    count = min(len(opened.images), config.max_scans or len(opened.images))
    real = opened.as_set(count, protocol.range_m)
    factories = [metric_factory(choice, settings) for choice in settings.chosen_metrics()]
    kept = keep_real(factories, real, settings.resampling, settings.pixel_statistics)
    errors = [each for each in kept if isinstance(each, LidarGritError)]
    if len(errors) == len(kept):
        raise errors[0]
    by = public_name(settings.protocol), protocol.sha256
    both = [*zip(factories, kept, strict=True)]
    return write_reference(path, by, opened, real, both, settings.resampling, keep_all=bool(settings.metrics))


def evaluate_pair(pair: EvalPair, settings: EvalConfig, cluster: Cluster | None = None) -> Scorecard:
    """Score two opened sets, by a cluster if one is given.

    Raises:
        LidarGritError: not one metric could be computed; the reason of the first.
    """
    protocol = load_protocol(settings.protocol)
    wanted, not_applicable = _applicable(settings.chosen_metrics(), pair)
    factories = [metric_factory(choice, settings) for choice in wanted]
    file = pair.reference.file if isinstance(pair.reference, FiledSet) else None
    kept = [file.kept(factory) for factory in factories] if file else []
    found = score_metrics(factories, pair, settings.resampling, settings.pixel_statistics, kept, cluster)
    scores = [score for score in found if isinstance(score, Score)]
    errors = [error for error in found if isinstance(error, LidarGritError)]
    left_out = [
        LeftOut(choice.metric, choice.variant, str(error))
        for choice, error in zip(wanted, found, strict=True)
        if isinstance(error, LidarGritError)
    ]
    if errors and not scores:
        raise errors[0]
    warnings = [*pair.warnings, *_doubts(scores, settings)]
    return Scorecard(
        public_name(settings.protocol),
        {
            "sha256": protocol.sha256,
            "title": protocol.title,
            "source": protocol.source,
            "range_m": protocol.range_m,
            "num_scans": protocol.num_scans,
            "data_set": protocol.data_set,
            "departures": list(protocol.departures),
        },
        pair.samples.record(),
        pair.reference.record(),
        tuple(scores),
        (*left_out, *not_applicable),
        (*pair.deviations, *_other_definitions(scores, protocol)),
        tuple(warnings),
        settings.facts(),
        {
            "lidargrit": __version__,
            "source_sha256": source_sha256(),
            "python": platform.python_version(),
            **{name: metadata.version(name) for name in ("torch", "numpy", "scipy")},
        },
        pair.leak,
    )


def _applicable(wanted: Sequence[MetricChoice], pair: EvalPair) -> tuple[list[MetricChoice], list[LeftOut]]:
    """Divide metrics into those that apply to two sets, and those that measure raydrop where a set has none."""
    why = pair.without_raydrop()
    kept: list[MetricChoice] = []
    others: list[LeftOut] = []
    for choice in wanted:
        cls = load_metric(choice.metric)
        if why and cls.measures_raydrop:
            others.append(LeftOut(choice.metric, choice.variant or cls.variants[0], why, NOT_APPLICABLE))
        else:
            kept.append(choice)
    return kept, others


def _other_definitions(scores: Sequence[Score], protocol: Protocol) -> list[str]:
    """Return the metrics of a protocol that were computed by other definitions than its own alone, one sentence each.

    Metrics that the protocol does not have are no difference: they change none of the others.
    """
    own: dict[str, list[str]] = {}
    for choice in protocol.metrics:
        own.setdefault(choice.metric, []).append(choice.variant or load_metric(choice.metric).variants[0])
    computed: dict[str, list[str]] = {}
    for score in scores:
        computed.setdefault(score.result.metric, []).append(score.result.variant)
    return [
        f"{metric} is computed by the definition {one_of(variants)}, not by {one_of(own[metric])}"
        for metric, variants in computed.items()
        if metric in own and not set(variants) & set(own[metric])
    ]


def metric_factory(choice: MetricChoice, settings: EvalConfig) -> MetricFactory:
    """Return what makes empty metrics of one definition, by the settings of an evaluation."""
    weights = settings.weights.get(load_metric(choice.metric).needs_weights)
    return MetricFactory(choice, settings.seed, weights, settings.device)


def _doubts(scores: Sequence[Score], settings: EvalConfig) -> list[str]:
    found = []
    if settings.resampling.halves and any(score.interval is None for score in scores):
        without = [score.result.metric for score in scores if score.interval is None]
        found.append(f"too few scans for the intervals of {', '.join(dict.fromkeys(without))}")
    if settings.pixel_statistics and any(score.pixel_statistics is None for score in scores):
        without = [score.result.metric for score in scores if score.pixel_statistics is None]
        found.append(f"too few scans for pixel statistics of {', '.join(dict.fromkeys(without))}")
    for score in scores:
        name = f"{score.result.metric} ({score.result.variant})"
        found += [f"{name}: {text}" for text in score.result.details.get("warnings", [])]
    return found


def _refuse_unused(samples: Source, config: EvalConfig) -> None:
    """Refuse a sensor or columns for generated images, which keep their own, and weights that no metric needs."""
    if samples.is_generated:
        columns, stride, default = config.data.columns, config.data.column_stride, DataConfig()
        held = f"for {samples.text}, which holds {samples.kind}"
        if config.sensor:
            raise ConfigError(
                f"--sensor {config.sensor} {held}",
                "a sensor for scans, or for range images in .npy files",
                "leave --sensor out: the reference is projected with the sensor of the samples",
            )
        if (columns, stride) != (default.columns, default.column_stride):
            raise ConfigError(
                f"--set data.columns={columns} data.column_stride={stride} {held}",
                "columns for scans, or for range images in .npy files",
                "leave them out: the reference is projected to the columns of the samples",
            )
    needed = {load_metric(choice.metric).needs_weights for choice in config.chosen_metrics()}
    if unused := sorted(config.weights.keys() - needed):
        raise ConfigError(
            f"--weights {unused[0]}={config.weights[unused[0]]}, which none of the chosen metrics needs",
            f"weights of {one_of(sorted(needed - {''}))}" if needed - {""} else "no weights",
            "leave it out, or choose a metric or protocol that needs it",
        )
