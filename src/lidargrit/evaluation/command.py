"""Two names and a configuration → scores or errors of reconstruction: what ``lidargrit evaluate`` does."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from lidargrit.core import discovery, reporting
from lidargrit.core.errors import ConfigError, nearest_names, one_of
from lidargrit.core.files import refuse_to_overwrite
from lidargrit.data.prepared.config import DataConfig, ScanSettings
from lidargrit.data.sources import RunSource, SampleSource, Source, TensorSource, open_source
from lidargrit.evaluation.comparison import EvalConfig, compare_pair, open_pair
from lidargrit.evaluation.intervals import Resampling
from lidargrit.evaluation.metrics import load_metric
from lidargrit.evaluation.pairs import EvalPair
from lidargrit.evaluation.protocols import DEFAULT, public_name
from lidargrit.evaluation.reconstruction import score_run
from lidargrit.evaluation.scorecard import Scorecard
from lidargrit.nn.devices import usable_device

_OF_TABLES = ("tables", "format", "json", "overwrite", "debug", "verb")  # options that printing takes as well


def evaluate(
    samples: str,
    reference: str,
    config: EvalConfig,
    report: Path | None = None,
    write_report: Callable[[Scorecard, EvalPair, Path], None] | None = None,
    overwrite: bool = False,
) -> tuple[str, dict[str, Any], Callable[[], None] | None]:
    """Score samples against a reference, or measure the reconstructions of a run.

    Args:
        samples: name of the first set: samples, any source of scans, or a finished run.
        reference: name of the second set.
        config: metrics, protocol and projection of the comparison.
        report: file for a report; a run has none.
        write_report: function that writes the report.
        overwrite: whether a report that is there already is replaced.

    Returns:
        a table, its plain values, and a function that writes the report, None where none is wanted.
    """
    if not (samples and reference):
        got = f"{samples!r} alone" if samples else "nothing to score"
        raise ConfigError(got, "samples and what they are compared with", "name two sets, or use --tables")
    refuse_to_overwrite(report, overwrite, ".html")
    usable_device(config.device)
    first = open_source(samples, config.data.bad_points, config.samples_format)
    second = open_source(reference, config.data.bad_points)
    if isinstance(first, RunSource):
        _refuse_options_of_samples(samples, config, report)
        return *_reconstruction(first, second, config), None
    _refuse_unused(first, config)
    pair = open_pair(first, second, config)
    card = compare_pair(pair, config)
    for warning in card.warnings[len(pair.warnings) :]:
        reporting.message(f"WARNING: {warning}")
    also = partial(write_report, card, pair, report) if report and write_report else None
    return card.as_table(), card.to_json(), also


def check_modes(options: Mapping[str, Any], default_of: Callable[[str], Any]) -> None:
    """Refuse words for scoring beside ``--tables``, which only prints, and a format of tables without it.

    Args:
        options: values of all options, by their names.
        default_of: function that returns the default of an option.
    """
    of_scoring = [name for name, value in options.items() if name not in _OF_TABLES and value != default_of(name)]
    if options["tables"] and of_scoring:
        got = f"--tables and {options['samples'] or '--' + of_scoring[0].replace('_', '-')}"
        raise ConfigError(got, "files of scores to print, or sets to score", "run the two one after the other")
    if options["format"] != "text" and not options["tables"]:
        cure = "score with --json FILE.json, then print it with --tables FILE.json"
        raise ConfigError(f"--format {options['format']} without --tables", "files of scores to print", cure)


def read_config(
    scans: ScanSettings | None = None,
    *,
    metrics: Sequence[str] = (),
    weights: Sequence[str] = (),
    groups: int = 16,
    intervals: int = 20,
    **settings: Any,
) -> EvalConfig:
    """Turn words and numbers, as a user types them, into a configuration.

    Args:
        metrics: names of metrics, in place of the protocol's.
        weights: words such as ``pointnet=FILE``.
        groups: number of groups that each set is cut into.
        intervals: number of half-samples; 0 for no intervals.
        settings: further settings of :class:`EvalConfig`, by name.
    """
    scans = scans or ScanSettings()
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


def _refuse_options_of_samples(run: str, config: EvalConfig, report: Path | None) -> None:
    """Refuse options of scoring samples, which have no meaning for the reconstructions of a run."""
    given = {
        "--report": report is not None,
        "--metrics": bool(config.metrics),
        "--variant": bool(config.variant),
        "--protocol": public_name(config.protocol) != DEFAULT,
        "--weights": bool(config.weights),
        "--pixel-statistics": config.pixel_statistics,
        "--sensor": bool(config.sensor),
        "--set data.columns or data.column_stride": _has_columns(config),
        "--intervals or --groups": replace(config.resampling, seed=0) != Resampling(),
        "--seed": config.resampling.seed != 0,
    }
    if wrong := [option for option, is_given in given.items() if is_given]:
        raise ConfigError(
            f"{wrong[0]} for the run {run}, of which only reconstructions are measured",
            "samples, or a run without this option",
            f"generate samples first with: lidargrit sample {run} FOLDER",
        )


def _has_columns(config: EvalConfig) -> bool:
    """Return whether columns are chosen, which only scans that are still to be projected can have."""
    default = DataConfig()
    return (config.data.columns, config.data.column_stride) != (default.columns, default.column_stride)


def _refuse_unused(samples: Source, config: EvalConfig) -> None:
    """Refuse a sensor or columns for generated images, which keep their own, and weights that no metric needs."""
    if config.sensor and isinstance(samples, (SampleSource, TensorSource)):
        raise ConfigError(
            f"--sensor {config.sensor} for {samples.text}, which holds {samples.kind}",
            "a sensor for scans, or for range images in .npy files",
            "leave --sensor out: the reference is projected with the sensor of the samples",
        )
    if _has_columns(config) and isinstance(samples, (SampleSource, TensorSource)):
        raise ConfigError(
            f"--set data.columns={config.data.columns} data.column_stride={config.data.column_stride} for "
            f"{samples.text}, which holds {samples.kind}",
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


def _reconstruction(run: RunSource, reference: Source, config: EvalConfig) -> tuple[str, dict[str, Any]]:
    variant = config.projection_variant or run.projection_variant(config.data) or "exact"
    data = replace(config.data, max_scans=config.max_scans, projection_variant=variant)
    errors = score_run(run, reference, data, config.device)
    about = {"samples": run.text, "reference": reference.text, "projection_variant": variant}
    table = "\n".join(f"{name:<22}{value:>10.4g}" for name, value in errors.items())
    return table, {**about, "reconstruction": errors}
