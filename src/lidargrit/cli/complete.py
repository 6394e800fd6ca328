"""Fill in what a scan lacks: rows, a sector, pixels, or rays without a point; all measured points stay."""

import argparse

from lidargrit.cli._completion import add_completion, named_sensor, open_model_for, run_task
from lidargrit.cli._options import add_ray

EXAMPLES = """\
  lidargrit complete /data/scans whole                             fill in every ray without a point
  lidargrit complete scan.bin four --samples 4 --observed sector:45,315 --model pretrained/lidargrit    four samples
  lidargrit complete /data/scans dense --observed rows:4 --model triangulation --sensor hdl64e_kitti_360
  lidargrit complete samples filled --observed mask.npy --format image
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    observed = "what is kept: returns, rows:N (every N-th), sector:A,B (degrees from A counter-clockwise to B, 0 is "
    observed += "ahead), pixels:SHARE (a random share), or an .npy of truth values, one for each pixel"
    parser.add_argument("--observed", default="returns", help=observed)
    add_completion(parser, "run that completes, or nearest, linear or triangulation")
    add_ray(parser)


def run(options: argparse.Namespace) -> None:
    from lidargrit.inference.complete import is_classical
    from lidargrit.inference.complete.patterns import Pattern
    from lidargrit.inference.complete.tasks import Fill

    task = Fill(Pattern(options.observed))
    sensor = named_sensor(options, is_classical(options.model))
    run_task(options, open_model_for(options, task, sensor), task)
