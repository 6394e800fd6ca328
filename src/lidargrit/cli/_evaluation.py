"""Options of ``evaluate`` → a table, its plain values, and what writes the report."""

import argparse
from collections.abc import Callable
from functools import partial
from typing import Any

from lidargrit.cli._options import scan_settings

_NAMES = "protocol metrics variant max_scans seed samples_format device weights groups intervals pixel_statistics"


def evaluated(options: argparse.Namespace) -> tuple[str, dict[str, Any], Callable[[], None] | None]:
    """Score by the options; simulated streets by the protocol of this name have a picture in place of a page."""
    from lidargrit.core.errors import ConfigError
    from lidargrit.core.files import refuse_to_overwrite
    from lidargrit.core.reporting import TerminalReporter
    from lidargrit.evaluation.command import evaluate, evaluate_streets, read_config, streets_of
    from lidargrit.viewer.curves import plot_curves
    from lidargrit.viewer.report import write_report

    config = read_config(scan_settings(options), **{name: vars(options)[name] for name in _NAMES.split()})
    sets = (options.samples, options.reference)
    streets = streets_of(options.samples, config) if options.reference else None
    if streets is None:
        if options.model:
            got, wanted = f"--model {options.model}", "simulated:COUNT and --protocol streets beside it"
            raise ConfigError(got, wanted, "leave it out, or see lidargrit likelihood --help")
        report = (options.report, write_report, options.overwrite)
        return evaluate(*sets, config, TerminalReporter(), *report)
    refuse_to_overwrite(options.report, options.overwrite, ".png")
    text, values, curves = evaluate_streets(sets[0], streets, sets[1], config, options.model, TerminalReporter())
    plot = partial(plot_curves, curves, options.report, f"real: {options.reference}") if options.report else None
    return text, values, plot
