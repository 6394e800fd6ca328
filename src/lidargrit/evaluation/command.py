"""What a user typed → scores: the words of ``lidargrit evaluate`` as one call of the library."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lidargrit import _discovery
from lidargrit.errors import ConfigError, nearest_names
from lidargrit.evaluation.comparison import EvalConfig, compare_sources
from lidargrit.evaluation.intervals import Resampling
from lidargrit.evaluation.pairs import EvalPair
from lidargrit.evaluation.reconstruction import evaluate_run
from lidargrit.evaluation.scorecard import Scorecard
from lidargrit.files import refuse_to_overwrite
from lidargrit.generators import is_run, locate
from lidargrit.loading import DataConfig
from lidargrit.metrics import load_metric
from lidargrit.nn.devices import usable_device
from lidargrit.reporting import Reporter


def evaluate(
    options: Namespace, reporter: Reporter, write_report: Callable[[Scorecard, EvalPair, Path], None]
) -> tuple[str, dict[str, Any]]:
    """Score as the options say, write the report if they name one, and return the result for people and for programs.

    Raises:
        ConfigError: an option that is missing or out of its bounds.
    """
    if not (options.samples and options.reference):
        got = f"{options.samples!r} alone" if options.samples else "nothing to score"
        raise ConfigError(got, "samples and what they are compared with", "name two sets, or use --tables")
    settings = settings_of(options)
    refuse_to_overwrite(options.report, options.overwrite)
    usable_device(settings.device)
    if is_run(locate(options.samples)):
        return _run(options, settings, reporter)
    card, pair = compare_sources(options.samples, options.reference, settings, reporter)
    for warning in card.warnings[len(pair.warnings) :]:
        reporter.message(f"WARNING: {warning}")
    if options.report:
        write_report(card, pair, options.report)
    return card.as_table(), card.to_json()


def settings_of(options: Namespace) -> EvalConfig:
    """Return the settings that a user's words name."""
    return EvalConfig(
        protocol=options.protocol,
        metrics=tuple(options.metrics),
        variant=options.variant,
        projection_variant=options.projection_variant,
        max_scans=options.max_scans,
        seed=options.seed,
        resampling=Resampling(options.groups, options.intervals, max(options.seed, 0)),
        weights=weights_of(options.weights),
        samples_format=options.samples_format,
        device=options.device,
        data=DataConfig(bad_points=options.bad_points, bad_scans=options.bad_scans),
    )


def weights_of(words: list[str]) -> dict[str, Path]:
    """Turn words such as ``pointnet=FILE`` into files by the name of their network.

    Raises:
        ConfigError: a word without ``=``, or a network that no metric looks through.
    """
    if not words:
        return {}
    known = {load_metric(name).needs_weights for name in _discovery.names("metrics")} - {""}
    files = {}
    for word in words:
        name, equals, path = word.partition("=")
        if not (equals and path) or name not in known:
            wanted = f"NAME=FILE with {nearest_names(name, known)} for NAME"
            raise ConfigError(f"--weights {word}", wanted, "name a network and the file with its weights")
        files[name] = Path(path)
    return files


def _run(options: Namespace, settings: EvalConfig, reporter: Reporter) -> tuple[str, dict[str, Any]]:
    config = DataConfig(
        max_scans=settings.max_scans,
        projection_variant=settings.projection_variant or "exact",
        bad_points=settings.data.bad_points,
        bad_scans=settings.data.bad_scans,
    )
    errors = evaluate_run(Path(options.samples), options.reference, config, reporter)
    about = {
        "samples": options.samples,
        "reference": options.reference,
        "projection_variant": config.projection_variant,
    }
    table = "\n".join(f"{name:<22}{value:>10.4g}" for name, value in errors.items())
    return table, {**about, "reconstruction": errors}
