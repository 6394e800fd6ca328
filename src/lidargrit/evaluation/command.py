"""Two names and a configuration → scores: what ``lidargrit evaluate`` does."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from lidargrit.core import discovery, reporting
from lidargrit.core.errors import ConfigError, nearest_names, one_of
from lidargrit.core.files import refuse_to_overwrite
from lidargrit.core.table import render
from lidargrit.data.datasets.shared.streets import Streets
from lidargrit.data.prepared.config import DataConfig, ScanSettings
from lidargrit.data.sources import DatasetSource, RunSource, SampleSource, Source, TensorSource, open_source
from lidargrit.evaluation.comparison import EvalConfig, compare_pair, open_pair
from lidargrit.evaluation.intervals import Resampling
from lidargrit.evaluation.metrics import load_metric
from lidargrit.evaluation.pairs import EvalPair
from lidargrit.evaluation.protocols import public_name
from lidargrit.evaluation.raydrop import raydrop_model, scores_of_model
from lidargrit.evaluation.realism import CurveScore, compare, scans_of_both, tables
from lidargrit.evaluation.scorecard import Scorecard
from lidargrit.nn.devices import usable_device


def evaluate(
    samples: str,
    reference: str,
    config: EvalConfig,
    report: Path | None = None,
    write_report: Callable[[Scorecard, EvalPair, Path], None] | None = None,
    overwrite: bool = False,
) -> tuple[str, dict[str, Any], Callable[[], None] | None]:
    """Score samples against a reference.

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
        raise ConfigError(
            f"the run {samples}, which holds no scans",
            "its samples, or scans to measure under it",
            f"lidargrit sample {samples} FOLDER, or lidargrit likelihood {reference} --model {samples}",
        )
    _refuse_unused(first, config)
    pair = open_pair(first, second, config)
    card = compare_pair(pair, config)
    for warning in card.warnings[len(pair.warnings) :]:
        reporting.message(f"WARNING: {warning}")
    also = partial(write_report, card, pair, report) if report and write_report else None
    return card.as_table(), card.to_json(), also


def streets_of(samples: str, config: EvalConfig) -> Streets | None:
    """Return the simulated streets that the protocol ``streets`` scores; None for other samples and protocols."""
    if public_name(config.protocol) != "streets" or not samples.startswith("simulated"):
        return None
    source = open_source(samples, config.data.bad_points)
    streets = source.scans() if isinstance(source, DatasetSource) else None
    return streets if isinstance(streets, Streets) else None


def evaluate_streets(
    samples: str, streets: Streets, reference: str, config: EvalConfig, model: str
) -> tuple[str, dict[str, Any], list[CurveScore]]:
    """Compare simulated streets, and independent drops of their clean scans, with real scans.

    Args:
        model: run that drops returns of clean scans, which is compared too; none if empty.

    Returns:
        tables, their plain values, and the curves, which can be plotted.
    """
    drops = raydrop_model(model, config.device) if model else None  # refused before anything is simulated
    simulated, real = scans_of_both(
        streets, open_source(reference, config.data.bad_points), config.sensor, config.data_config()
    )
    of_model = scores_of_model(drops, simulated, real) if drops else []
    scores = compare(simulated, real)
    about = {"protocol": "streets", "samples": samples, "reference": reference, "settings": config.facts()}
    found = {"curves": [each.to_json() for each in scores], "raydrop": [each.to_json() for each in of_model]}
    return render(tables([*scores, *of_model])), {**about, **found}, scores


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
        weights: words such as ``pointnet=FILE``.
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
