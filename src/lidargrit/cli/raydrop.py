"""Add raydrop to clean simulated scans: drop the returns that a real sensor would not get."""

import argparse

from lidargrit.cli._options import add_bad_scans, add_completion
from lidargrit.core.errors import counted_scans

EXAMPLES = """\
  lidargrit raydrop /data/carla_scans dropped
  lidargrit raydrop clean.npy dropped --format image --probability 32      a range image, and P(return)
  lidargrit raydrop /data/carla_scans dropped -n 4 --seed 100              each scan in four ways
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.set_defaults(goes_on=True)
    share = "also write NAME.probability.npy, the share of returns of each pixel over this many samples"
    parser.add_argument("--probability", type=int, default=0, metavar="SAMPLES", help=share)
    add_completion(parser, "run whose sensor's raydrop is wanted")
    add_bad_scans(parser)


def run(options: argparse.Namespace) -> None:
    """Drop returns, and say where the scans are."""
    from lidargrit.core.reporting import TerminalReporter
    from lidargrit.data.prepared.config import DataConfig
    from lidargrit.inference.complete import open_model
    from lidargrit.inference.complete.command import raydrop_scans
    from lidargrit.inference.complete.files import OutputConfig

    model = open_model(options.model, "surfaces", None, options.set, options.device)
    output = OutputConfig(options.count, options.seed, options.format, options.probability)
    config = DataConfig(max_scans=options.max_scans, bad_points=options.bad_points, bad_scans=options.bad_scans)
    count = raydrop_scans(options.scans, options.out, model, output, config, TerminalReporter())
    print(f"done: {counted_scans(count)} with raydrop in {options.out}")
