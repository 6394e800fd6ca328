"""Score any scans against any others."""

from __future__ import annotations

import argparse
from pathlib import Path

EXAMPLES = """\
  lidargrit evaluate samples /data/held_out
  lidargrit evaluate samples kitti_odometry:/data/kitti_odometry:test --metrics sliced_wasserstein --json scores.json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.add_argument("samples", help="a folder of samples, or a source of scans")
    parser.add_argument("reference", help="likewise; projected with the sensor of the samples")
    parser.add_argument("--metrics", nargs="+", default=["sliced_wasserstein"], help="see: lidargrit list metrics")
    parser.add_argument("--variant", help="one definition only, such as reference (default: all that a metric has)")
    parser.add_argument("--projection-variant", choices=["exact", "reference"], default="exact", help="of scans")
    parser.add_argument("-n", "--max-scans", type=int, default=0, help="at most so many of each; 0 for all")
    parser.add_argument("--seed", type=int, default=0, help="of whatever a metric draws")
    parser.add_argument("--json", type=Path, help="also write the scores to this file")


def run(options: argparse.Namespace) -> None:
    """Score and print a table."""
    from lidargrit.evaluation.score import as_json, as_table, evaluate, open_images
    from lidargrit.files import write_json
    from lidargrit.reporting import TerminalReporter

    reporter, road = TerminalReporter(), options.projection_variant
    samples = open_images(options.samples, None, options.max_scans, road, reporter)
    reference = open_images(options.reference, samples.sensor, options.max_scans, road, reporter)
    results = evaluate(samples, reference, options.metrics, options.variant, options.seed)
    print(as_table(results))
    if options.json:
        about = {"samples": options.samples, "reference": options.reference, "projection_variant": road}
        write_json(options.json, {**about, "seed": options.seed, "scores": as_json(results)})
