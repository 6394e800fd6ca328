"""Make scans of a sensor with few rows into scans of one with more rows."""

import argparse

from lidargrit.cli._options import add_bad_scans, add_completion
from lidargrit.core.errors import counted_scans

EXAMPLES = """\
  lidargrit upsample /data/vlp16 dense --sensor vlp16                          by pretrained, a model in the package
  lidargrit upsample nuscenes:/data/nuscenes dense -n 4                       four masks over one estimate of the ranges
  lidargrit upsample scan.pcd dense --sensor vlp16 --to os1_64 --model triangulation
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.set_defaults(goes_on=True)
    parser.add_argument("--sensor", default="", help="sensor that made the scans (default: that of the source)")
    parser.add_argument("--to", default="", help="sensor of the dense scans (default: that of the run)")
    add_completion(parser, "run that adds the rows, or nearest, linear or triangulation", points_only=True)
    add_bad_scans(parser)


def run(options: argparse.Namespace) -> None:
    """Add the rows, and say where the scans are."""
    from lidargrit.core.reporting import TerminalReporter
    from lidargrit.data.prepared.config import DataConfig
    from lidargrit.inference.complete import open_model
    from lidargrit.inference.complete.command import upsample_scans
    from lidargrit.inference.complete.files import OutputConfig
    from lidargrit.inference.complete.inputs import sensor_of
    from lidargrit.scans.sensors import load_sensor

    scans_sensor = sensor_of(options.scans, options.sensor)
    wanted_sensor = load_sensor(options.to) if options.to else None
    model = open_model(options.model, "pixels", wanted_sensor, options.set, options.device)
    output = OutputConfig(options.count, options.seed, options.format)
    config = DataConfig(max_scans=options.max_scans, bad_points=options.bad_points, bad_scans=options.bad_scans)
    count = upsample_scans(options.scans, options.out, model, scans_sensor, output, config, TerminalReporter())
    print(f"done: {counted_scans(count)} of {model.sensor.name} in {options.out}")
