"""Add the rows between those of a sensor with few; all measured points stay."""

import argparse

from lidargrit.cli._completion import add_completion, named_sensor, open_model_for, run_task

EXAMPLES = """\
  lidargrit upsample /data/vlp16 dense --sensor vlp16                          by pretrained, a model in the package
  lidargrit upsample nuscenes:/data/nuscenes dense --samples 4                four masks over one estimate of the ranges
  lidargrit upsample scan.pcd dense --sensor vlp16 --to os1_64 --model triangulation
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--to", default="", help="sensor of the dense scans (default: that of the run)")
    add_completion(parser, "run that adds the rows, or nearest, linear or triangulation", points_only=True)


def run(options: argparse.Namespace) -> None:
    from lidargrit.inference.complete.tasks import AddRows
    from lidargrit.scans.sensors import load_sensor

    made_by = named_sensor(options, is_needed=True)
    assert made_by is not None
    task = AddRows(made_by)
    wanted = load_sensor(options.to) if options.to else None
    run_task(options, open_model_for(options, task, wanted), task)
