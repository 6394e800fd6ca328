"""Compare simulated with real scans: raydrop, ranges and reflectance, with a picture of the curves."""

import argparse
from pathlib import Path

from lidargrit.cli._options import add_device, add_scans, scan_settings
from lidargrit.cli._results import add_json, print_result, refuse_taken
from lidargrit.core.untrusted import seed_number

EXAMPLES = """\
  lidargrit compare-sim /data/kitti_odometry
  lidargrit compare-sim /data/kitti_odometry --model pretrained       and how a model drops returns of clean scans
  lidargrit compare-sim kitti_raw:/data/kitti_raw:2011_09_26_drive_0001_sync -n 64 --json curves.json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.add_argument("real", metavar="REAL", help="source of real scans")
    parser.add_argument("-n", "--count", type=int, default=32, help="number of simulated scans, and the most real ones")
    fine = "compare every column that the sensor fires, not only those that the data set keeps"
    parser.add_argument("--fine", action="store_true", help=fine)
    drops = "run that drops returns of clean scans; its drops are compared, too"
    parser.add_argument("--model", default="", metavar="RUN", help=drops)
    parser.add_argument("--seed", type=seed_number, default=0, help="seed of the first simulated scan")
    parser.add_argument(
        "-o", "--out", type=Path, default=Path("compare_sim.png"), metavar="PNG", help="picture of the curves"
    )
    add_scans(parser)
    add_device(parser)
    add_json(parser, "the files of --out and --json")


def run(options: argparse.Namespace) -> None:
    """Simulate, compare, print a table and plot the curves."""
    from lidargrit.core.errors import ConfigError
    from lidargrit.core.files import refuse_to_overwrite
    from lidargrit.evaluation.raydrop import raydrop_json, raydrop_model, raydrop_table, scores_of_model
    from lidargrit.evaluation.realism import as_json, as_table, compare, scans_of_both
    from lidargrit.viewer.curves import plot_curves

    if options.device and not options.model:
        raise ConfigError(f"--device {options.device} without --model", "a run that computes", "leave --device out")
    refuse_to_overwrite(options.out, options.overwrite, ".png")
    refuse_taken(options)
    model = raydrop_model(options.model, options.device) if options.model else None  # before scans are simulated
    settings = scan_settings(options)
    about = {"real": options.real, "count": options.count, "sensor": settings.sensor, "fine": options.fine}
    simulated, real = scans_of_both(
        options.real, options.count, settings.sensor, options.fine, options.seed, settings.data
    )
    drops = scores_of_model(model, simulated, real) if model else []
    scores = compare(simulated, real)
    plot_curves(scores, options.out, f"real: {options.real}")
    result = {**about, "seed": options.seed, "curves": as_json(scores), "raydrop": raydrop_json(drops)}
    tables = "\n\n".join([as_table(scores), *([raydrop_table(drops)] if drops else [])])
    print_result(options, tables, result, f"done: look at {options.out}")
