"""Score any scans against any others, or what a run keeps of scans."""

from __future__ import annotations

import argparse
from pathlib import Path

EXAMPLES = """\
  lidargrit evaluate samples /data/held_out
  lidargrit evaluate runs/mine /data/held_out          errors of reconstruction, for a run instead of samples
  lidargrit evaluate samples kitti_odometry:/data/kitti_odometry:test --metrics sliced_wasserstein --json scores.json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.add_argument("samples", help="a folder of samples, a source of scans, or a run")
    parser.add_argument("reference", help="likewise; projected with the sensor of the samples")
    parser.add_argument("--metrics", nargs="+", default=["sliced_wasserstein"], help="see: lidargrit list metrics")
    parser.add_argument("--variant", help="one definition only, such as reference (default: all that a metric has)")
    parser.add_argument("--projection-variant", choices=["exact", "reference"], default="exact", help="of scans")
    parser.add_argument("-n", "--max-scans", type=int, default=0, help="at most so many of each; 0 for all")
    parser.add_argument("--seed", type=int, default=0, help="of whatever a metric draws")
    parser.add_argument("--bad-points", choices=["refuse", "drop"], default="refuse", help="NaN, infinite or at 0")
    parser.add_argument("--bad-scans", choices=["refuse", "skip"], default="refuse", help="that cannot be used")
    parser.add_argument("--json", type=Path, help="also write the scores to this file")
    parser.add_argument("--overwrite", action="store_true", help="replace that file if it is there already")


def run(options: argparse.Namespace) -> None:
    """Score and print a table."""
    from lidargrit.errors import ConfigError
    from lidargrit.evaluation.score import as_json, as_table, evaluate, evaluate_run, open_images
    from lidargrit.files import refuse_to_overwrite, write_json
    from lidargrit.generators import is_run
    from lidargrit.loading import DataConfig
    from lidargrit.reporting import TerminalReporter

    if options.max_scans < 0 or options.seed < 0:
        raise ConfigError(f"-n {options.max_scans}, --seed {options.seed}", "0 or more", "correct the number")
    refuse_to_overwrite(options.json, options.overwrite)
    reporter, road = TerminalReporter(), options.projection_variant
    bad = {"bad_points": options.bad_points, "bad_scans": options.bad_scans}
    config = DataConfig(max_scans=options.max_scans, variant=road, **bad)
    about = {"samples": options.samples, "reference": options.reference, "projection_variant": road, **bad}
    if is_run(Path(options.samples)):
        errors = evaluate_run(Path(options.samples), options.reference, config, reporter)
        print("\n".join(f"{name:<20}{value:>10.4g}" for name, value in errors.items()))
        if options.json:
            write_json(options.json, {**about, "reconstruction": errors})
        return
    samples = open_images(options.samples, None, config, reporter)
    reference = open_images(options.reference, samples.sensor, config, reporter)
    results = evaluate(samples, reference, options.metrics, options.variant, options.seed)
    print(as_table(results))
    if options.json:
        write_json(options.json, {**about, "seed": options.seed, "scores": as_json(results)})
