"""Fill in what a scan lacks: rows, a sector, pixels, or rays without a point."""

import argparse

from lidargrit.cli._options import add_bad_scans, add_completion
from lidargrit.core.errors import counted_scans

EXAMPLES = """\
  lidargrit complete /data/scans whole                             fill in every ray without a point
  lidargrit complete scan.bin four -n 4 --observed sector:45,315 --model pretrained/lidargrit    four samples
  lidargrit complete /data/scans dense --observed rows:4 --model triangulation --sensor hdl64e_kitti_360
  lidargrit complete samples filled --observed mask.npy --format image
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.set_defaults(goes_on=True)
    observed = "what is kept: returns, rows:N (every N-th), sector:A,B (degrees from A counter-clockwise to B, 0 is "
    observed += "ahead), pixels:SHARE (a random share), or an .npy of truth values, one for each pixel"
    parser.add_argument("--observed", default="returns", help=observed)
    sensor = "sensor of the scans, for a classical method (default: the source's); a run has its own"
    parser.add_argument("--sensor", default="", help=sensor)
    add_completion(parser, "run that completes, or nearest, linear or triangulation")
    add_bad_scans(parser)


def run(options: argparse.Namespace) -> None:
    """Complete the scans, and say where they are."""
    from lidargrit.core.reporting import TerminalReporter
    from lidargrit.data.prepared.config import DataConfig
    from lidargrit.inference.complete import is_classical, open_model
    from lidargrit.inference.complete.command import complete_scans
    from lidargrit.inference.complete.files import OutputConfig
    from lidargrit.inference.complete.inputs import sensor_of
    from lidargrit.inference.complete.patterns import Pattern

    pattern = Pattern(options.observed)
    named = options.sensor or is_classical(options.model)
    sensor = sensor_of(options.scans, options.sensor) if named else None
    model = open_model(options.model, "pixels", sensor, options.set, options.device)
    output = OutputConfig(options.count, options.seed, options.format)
    config = DataConfig(max_scans=options.max_scans, bad_points=options.bad_points, bad_scans=options.bad_scans)
    count = complete_scans(options.scans, options.out, model, pattern, output, config, TerminalReporter())
    print(f"done: {counted_scans(count, 'completed')} in {options.out}; completed.json says how they were made")
