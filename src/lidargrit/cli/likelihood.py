"""Measure the likelihood of scans under a model, in bits: tokens, mask and ranges."""

import argparse
from pathlib import Path

from lidargrit.cli._options import add_bad_scans, add_device
from lidargrit.cli._results import add_json, print_result, refuse_taken

EXAMPLES = """\
  lidargrit likelihood simulated:64:test
  lidargrit likelihood /data/kitti_odometry --model runs/mine --step-mm 2 --max-scans 100
  lidargrit likelihood /data/held_out --map bits.npy --json bits.json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    add = parser.add_argument
    add("scans", help="source of scans: a file's folder, NAME:ROOT:SPLIT, samples, or prepared scans")
    add("--model", default="pretrained", help="run whose probabilities count (default: pretrained)")
    add("--step-mm", type=int, default=10, metavar="MM", help="step in millimetres that ranges are rounded to first")
    add("-n", "--max-scans", type=int, default=0, help="largest number of scans, evenly spaced; 0 for all")
    add(
        "--map",
        type=Path,
        metavar="FILE.npy",
        help="also write the bits of every pixel: float32 (scans, rows, columns)",
    )
    add_bad_scans(parser)
    add_device(parser)
    add_json(parser, "the files of --json and --map")


def run(options: argparse.Namespace) -> None:
    """Count the bits and print a table."""
    from lidargrit.core.files import refuse_to_overwrite
    from lidargrit.data.prepared.config import DataConfig
    from lidargrit.evaluation.likelihood import likelihood_of_source

    refuse_taken(options)
    if options.map is not None:
        refuse_to_overwrite(options.map, options.overwrite, ".npy")
    config = DataConfig(max_scans=options.max_scans, bad_points=options.bad_points, bad_scans=options.bad_scans)
    named = (options.scans, options.model, options.step_mm)
    found = likelihood_of_source(*named, config, options.map, options.device)
    result = {"model": options.model, "source": options.scans, **found.as_json()}
    print_result(options, found.as_table(), result)
