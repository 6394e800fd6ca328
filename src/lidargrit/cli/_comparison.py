"""Options of ``compare`` → one of three tables: systems by a protocol, a table of the paper, completions."""

import argparse
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from lidargrit.cli._options import SCANS, refuse_unused, scan_settings, scan_words

if TYPE_CHECKING:
    from lidargrit.evaluation.compare import CompareConfig
    from lidargrit.evaluation.reproduction import Reproduction

COMPLETION, COMPLETED = "completion", "completion.json"
DEFAULTS: dict[str, Any] = {
    "reference": "simulated:256:test",
    "count": 256,
    "protocol": "exact",
    "metrics": [],
    "flops": 0.0,
    "set": [],
}
"""Settings that all systems share where the user gives none; a table that is extended keeps its own."""
_OF_SYSTEMS = ("systems", "add", "workers", "table", *DEFAULTS, *SCANS)
_OF_PAPER = ("paper_table", "data", "small", "count", "flops", "table", "workers", "dry_run", *SCANS)
_OF_COMPLETION = ("systems", "protocol", "reference", "count", "observed", "samples", "seed", "device", "table", *SCANS)


def compared(options: argparse.Namespace) -> tuple[str, Any, str]:
    """Compare by the options, write what was found into the folder, and return a table, its plain values, a last line.

    The same command goes on, but for completions, which begin anew.
    """
    from lidargrit.core.files import write_text
    from lidargrit.evaluation.compare import PAGE, as_json, as_table, run
    from lidargrit.evaluation.reproduction import plan, plan_as_text, prepare
    from lidargrit.evaluation.table_folder import write_table
    from lidargrit.viewer.table_page import table_page

    if options.protocol == COMPLETION:
        options.goes_on = False
        return *_completions(options), f"done: the same as JSON in {options.out / COMPLETED}"
    paper = _paper_table(options)
    if paper and options.dry_run:
        facts = plan(paper, options.out)
        return plan_as_text(paper, facts), facts, ""
    systems, comparison = ([*paper.systems().values()], paper.comparison()) if paper else _systems(options)
    if paper:
        prepare(comparison, systems)
    scores = run(systems, options.out, comparison, options.workers)
    write_table(options.out, systems, comparison, scores)
    write_text(options.out / PAGE, table_page(as_json(scores), comparison.flops))
    done = f"done: {options.out / PAGE} sorts the table in a browser"
    return as_table(scores, options.table, paper.remarks() if paper else ()), as_json(scores), done


def _systems(options: argparse.Namespace) -> "tuple[list[str], CompareConfig]":
    from lidargrit.core.errors import ConfigError
    from lidargrit.data.prepared.config import DataConfig
    from lidargrit.evaluation.compare import CompareConfig
    from lidargrit.evaluation.evaluate import EvalConfig
    from lidargrit.evaluation.table_folder import read_table

    refuse_unused(options, "without --paper-table or --protocol completion", _OF_SYSTEMS)
    given = {name: value for name in (*DEFAULTS, *SCANS) if (value := getattr(options, name)) not in (None, [], "")}
    if options.add:
        if options.systems or given:
            own = [f"--{name}" if name != "count" else "-n" for name in given]
            raise ConfigError(
                f"--add with {'systems before it' if options.systems else f'settings of its own ({own[0]})'}",
                "--add SYSTEM ... alone: all else is as in the table",
                "leave them out, or begin a table in another folder",
            )
        systems, comparison = read_table(options.out)
        return [*systems, *(system for system in options.add if system not in systems)], comparison
    chosen = DEFAULTS | given
    reading = DataConfig(**{name: given[name] for name in ("projection", "bad_points", "bad_scans") if name in given})
    return options.systems, CompareConfig(
        reference=chosen["reference"],
        num_samples=chosen["count"],
        settings=EvalConfig(chosen["protocol"], tuple(chosen["metrics"]), data=reading),
        preset_settings=tuple(scan_words(options)),
        flops=chosen["flops"],
    )


def _paper_table(options: argparse.Namespace) -> "Reproduction | None":
    """Return the table of the paper to reproduce; None if no table is named."""
    from lidargrit.core.errors import ConfigError
    from lidargrit.evaluation.reproduction import Reproduction

    if options.paper_table is None:
        return None
    refuse_unused(options, f"with --paper-table {options.paper_table}", _OF_PAPER)
    if not options.data:
        cure = "name the folder of KITTI-360 (table 1) or KITTI odometry (2, 3), or --data simulated"
        raise ConfigError(f"--paper-table {options.paper_table} without --data", "its data set", cure)
    settings = (options.small, options.count or 0, options.flops, tuple(scan_words(options)))
    return Reproduction(options.paper_table, options.data, *settings)


def _completions(options: argparse.Namespace) -> tuple[str, dict[str, Any]]:
    """Hide parts of whole scans, have every model fill them in, and return the table and its plain values."""
    from lidargrit.core.files import refuse_to_overwrite, write_json
    from lidargrit.core.table import render
    from lidargrit.data.sources import open_source
    from lidargrit.data.sources.scan_sensor import sensor_for
    from lidargrit.evaluation.completion import PATTERNS, compare_completion, tables
    from lidargrit.inference.complete import is_classical, open_models
    from lidargrit.inference.complete.inputs import images_for
    from lidargrit.inference.complete.patterns import Pattern
    from lidargrit.scans.fills import FILLS

    refuse_unused(options, "with --protocol completion", _OF_COMPLETION)
    file = options.out / COMPLETED
    refuse_to_overwrite(file, options.overwrite, ".json")
    patterns = [Pattern(text) for text in options.observed or PATTERNS]
    words, scans = options.systems or ["pretrained", *FILLS], options.reference or DEFAULTS["reference"]
    settings = scan_settings(options, max_scans=32 if options.count is None else options.count)
    named = settings.sensor or settings.data.columns or all(is_classical(word) for word in words)
    source = open_source(scans, settings.data.bad_points)
    sensor = settings.data.with_projection(sensor_for(source, settings.sensor)) if named else None
    models = open_models(words, sensor, options.device)
    images = images_for(models, scans, settings)
    skips = settings.data.bad_scans == "skip"
    scores = compare_completion(images, models, patterns, options.samples, options.seed, skips)
    found = {"reference": scans, "scores": [asdict(score) for score in scores]}
    write_json(file, found)
    return render(tables(scores), options.table), found
