"""Add raydrop to clean simulated scans: drop the points that a real sensor would not get."""

import argparse

from lidargrit.cli._completion import add_completion, named_sensor, open_model_for, run_task

EXAMPLES = """\
  lidargrit raydrop /data/carla_scans dropped
  lidargrit raydrop clean.npy dropped --format image --probability 32      a range image, and P(return)
  lidargrit raydrop /data/carla_scans dropped --samples 4 --seed 100       each scan in four ways
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    share = "also write NAME.probability.npy, the share of returns of each pixel over this many samples"
    parser.add_argument("--probability", type=int, default=0, metavar="SAMPLES", help=share)
    add_completion(parser, "run whose sensor's raydrop is wanted")


def run(options: argparse.Namespace) -> None:
    from lidargrit.inference.complete.tasks import Drop

    task = Drop()
    run_task(options, open_model_for(options, task, named_sensor(options, False, "raydrop")), task, options.probability)
