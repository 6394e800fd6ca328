"""Options of ``evaluate`` → a table, its plain values, and what writes the report."""

import argparse
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from lidargrit.cli._options import SCANS, refuse_unused, scan_settings

if TYPE_CHECKING:
    from lidargrit.evaluation.evaluate import EvalConfig

_OF_BOTH = ("samples", "reference", "protocol", "count", "device", "report", *SCANS)
_OF_REFERENCE = ("samples", "protocol", "count", "device", *SCANS)
_OF_CARDS = ("metrics", "variant", "seed", "samples_format", "weights", "groups", "intervals", "pixel_statistics")


def evaluated(options: argparse.Namespace) -> tuple[str, dict[str, Any], Callable[[], None] | None]:
    """Score by the options; simulated streets have a picture in place of a page."""
    from lidargrit.core.errors import ConfigError
    from lidargrit.core.files import refuse_to_overwrite
    from lidargrit.evaluation.drives import DRIVE, MEASURED
    from lidargrit.evaluation.evaluate import evaluate_sources, read_config
    from lidargrit.evaluation.protocols import public_name
    from lidargrit.evaluation.raydrop import evaluate_streets, streets_of
    from lidargrit.evaluation.reference_file import ENDING
    from lidargrit.viewer.curves import plot_curves
    from lidargrit.viewer.report import write_report

    if public_name(options.protocol) in (*MEASURED, DRIVE):
        return *_of_drives(options), None
    names = ("protocol", "device", *_OF_CARDS)
    settings = scan_settings(options, max_scans=options.count)
    config = read_config(settings, **{name: vars(options)[name] for name in names})
    sets = (options.samples, options.reference)
    if options.save_reference:
        refuse_unused(options, "with --save-reference", ("save_reference", *_OF_REFERENCE, *_OF_CARDS))
        return *_saved(options, config), None
    is_file = sets[1].lower().endswith(ENDING)
    if options.report and is_file:
        raise ConfigError(f"--report with {sets[1]}, which holds no scan", "scans to show", "leave it out")
    streets = streets_of(options.samples, config) if options.reference and not is_file else None
    if streets is None:
        refuse_unused(options, "without --protocol streets", ("ray", *_OF_BOTH, *_OF_CARDS))
        refuse_to_overwrite(options.report, options.overwrite, ".html")
        card, pair = evaluate_sources(*sets, config, options.ray)
        report = partial(write_report, card, pair, options.report) if options.report else None
        return card.as_table(), card.to_json(), report
    refuse_unused(options, "with --protocol streets", (*_OF_BOTH, "model", "beside"))
    refuse_to_overwrite(options.report, options.overwrite, ".png")
    text, values, curves = evaluate_streets(sets[0], streets, sets[1], config, options.model, options.beside)
    plot = partial(plot_curves, curves, options.report, f"real: {options.reference}") if options.report else None
    return text, values, plot


def _of_drives(options: argparse.Namespace) -> tuple[str, dict[str, Any]]:
    """Score forecasts of drives, or how well the scans of one or two sets of drives fit together."""
    from lidargrit.core.errors import UsageError
    from lidargrit.evaluation.drives import MEASURED, evaluate_drives, evaluate_forecast
    from lidargrit.evaluation.evaluate import read_config
    from lidargrit.evaluation.protocols import public_name

    settings = scan_settings(options, max_scans=options.count)
    config = read_config(settings, protocol=options.protocol, device=options.device)
    if not options.samples:
        raise UsageError(
            "no drives", "their folder or source", "name it, as in lidargrit evaluate DRIVES --protocol drive"
        )
    used = ("samples", "protocol", "count", "device", *SCANS)
    if public_name(options.protocol) in MEASURED:
        refuse_unused(options, f"with --protocol {options.protocol}", (*used, "model"))
        return evaluate_forecast(options.samples, config, options.model)
    refuse_unused(options, "with --protocol drive", (*used, "reference"))
    return evaluate_drives([*filter(None, (options.samples, options.reference))], config)


def _saved(options: argparse.Namespace, config: "EvalConfig") -> tuple[str, dict[str, Any]]:
    """Save what metrics keep of the scans that stand where samples do, and return what the file holds."""
    from lidargrit.core.files import refuse_to_overwrite
    from lidargrit.evaluation.evaluate import save_reference
    from lidargrit.evaluation.reference_file import ENDING

    refuse_to_overwrite(options.save_reference, options.overwrite, ENDING)
    file = save_reference(options.samples, options.save_reference, config)
    return file.as_text(), file.facts()
