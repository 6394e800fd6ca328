"""Add the rows between those of a sensor with few; all measured points stay."""

import argparse

from lidargrit.cli._completion import add_completion, open_model_for, run_task

EXAMPLES = """\
  lidargrit upsample /data/vlp16 dense --sensor vlp16                          by pretrained, a model in the package
  lidargrit upsample nuscenes:/data/nuscenes dense -n 4                       four masks over one estimate of the ranges
  lidargrit upsample scan.pcd dense --sensor vlp16 --to os1_64 --model triangulation
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.add_argument("--sensor", default="", help="sensor that made the scans (default: that of the source)")
    parser.add_argument("--to", default="", help="sensor of the dense scans (default: that of the run)")
    add_completion(parser, "run that adds the rows, or nearest, linear or triangulation", points_only=True)


def run(options: argparse.Namespace) -> None:
    """Add the rows, and say where the scans are."""
    from lidargrit.inference.complete.inputs import sensor_of
    from lidargrit.inference.complete.tasks import AddRows
    from lidargrit.scans.sensors import load_sensor

    task = AddRows(sensor_of(options.scans, options.sensor))
    wanted = load_sensor(options.to) if options.to else None
    run_task(options, open_model_for(options, task, wanted), task)
