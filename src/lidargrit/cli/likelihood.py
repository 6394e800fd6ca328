"""Measure scans under a model: their likelihood in bits, and the errors of their reconstructions."""

import argparse
from pathlib import Path

from lidargrit.cli._options import add_count, add_device, add_scans, add_step, scan_settings
from lidargrit.cli._results import add_json, print_result, refuse_taken

EXAMPLES = """\
  lidargrit likelihood simulated:64:test
  lidargrit likelihood /data/kitti_odometry --model runs/mine --step-mm 2 -n 100
  lidargrit likelihood /data/held_out --map bits.npy --json bits.json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("scans", help="source of scans: a file's folder, NAME:ROOT:SPLIT, samples, or prepared scans")
    add("--model", default="pretrained", help="run whose probabilities count (default: pretrained)")
    add_step(parser, "step in millimetres that ranges are rounded to first")
    add_count(parser)
    bits = "also write the bits of every pixel: float32 (scans, rows, columns)"
    add("--map", type=Path, metavar="FILE.npy", help=bits)
    add_scans(parser)
    add_device(parser)
    add_json(parser, "the files of --json and --map")


def run(options: argparse.Namespace) -> None:
    from lidargrit.core.files import refuse_to_overwrite
    from lidargrit.data.sources.scan_sensor import sensor_for_run
    from lidargrit.evaluation.likelihood import measure_source

    refuse_taken(options, replaces_others=True)
    refuse_to_overwrite(options.map, options.overwrite, ".npy")
    named = (options.scans, options.model, options.step_mm)
    settings = scan_settings(options, max_scans=options.count)
    sensor = sensor_for_run(settings, options.scans, options.model)
    print_result(options, *measure_source(*named, settings.data, options.map, options.device, sensor))
