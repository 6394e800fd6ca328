"""Compare completions: hide parts of whole scans, fill them in by models and classical methods, and measure errors."""

import argparse

from lidargrit.cli._options import add_device, add_scans, scan_settings
from lidargrit.cli._results import add_json, print_result, refuse_taken
from lidargrit.core.untrusted import seed_number

EXAMPLES = """\
  lidargrit compare-completion simulated:64:test
  lidargrit compare-completion /data/kitti_odometry pretrained runs/r2dm linear triangulation -n 32
  lidargrit compare-completion /data/held_out pretrained/completion pretrained/lidargrit     two runs of one bundle
  lidargrit compare-completion /data/held_out --observed rows:8 pixels:0.05 --json table.json
  lidargrit compare-completion /data/held_out linear triangulation --set data.columns=2048 data.column_stride=2
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.add_argument("scans", help="source of whole scans, which no model has learned from")
    models = "runs, nearest, linear or triangulation (default: pretrained and all three)"
    parser.add_argument("models", nargs="*", metavar="MODEL", help=models)
    patterns = "what is kept, as of lidargrit complete (default: rows:4 sector:45,315 pixels:0.1)"
    parser.add_argument("--observed", nargs="+", default=[], metavar="PATTERN", help=patterns)
    parser.add_argument("-n", "--count", type=int, default=32, help="largest number of scans, evenly spaced; 0 for all")
    each = "number of completions of each scan by a model that is random"
    parser.add_argument("--completions", type=int, default=2, help=each)
    parser.add_argument("--seed", type=seed_number, default=0, help="seed of the completions and of random pixels")
    add_scans(parser)
    add_device(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Complete, measure and print a table."""
    from lidargrit.evaluation.completion import PATTERNS, as_json, as_table, compare_completion
    from lidargrit.inference.complete import is_classical, open_models
    from lidargrit.inference.complete.inputs import images_for, sensor_of
    from lidargrit.inference.complete.patterns import Pattern
    from lidargrit.scans.fills import FILLS

    refuse_taken(options)
    patterns = [Pattern(text) for text in options.observed or PATTERNS]
    words = options.models or ["pretrained", *FILLS]
    settings = scan_settings(options, max_scans=options.count)
    named = settings.sensor or settings.data.columns or all(is_classical(word) for word in words)
    sensor = settings.data.imaged(sensor_of(options.scans, settings.sensor)) if named else None
    models = open_models(words, sensor, options.device)
    images = images_for(models, options.scans, settings)
    scores = compare_completion(images, models, patterns, options.completions, options.seed)
    print_result(options, as_table(scores), {"scans": options.scans, "scores": as_json(scores)})
