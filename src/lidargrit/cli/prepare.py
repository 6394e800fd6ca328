"""Project scans once: range images in compressed shards, by many processes, taken up again where stopped."""

from __future__ import annotations

import argparse
from pathlib import Path

from lidargrit.cli._results import add_json, refuse_taken, tell

EXAMPLES = """\
  lidargrit prepare kitti_360:/data/KITTI-360:train -o /fast/kitti_360_train --workers 16
  lidargrit train lidargrit_kitti_360 runs/mine --set data.train=/fast/kitti_360_train data.val=...
  lidargrit prepare /data/my_scans --sensor my_sensor.json       into the cache, where train finds it
  lidargrit prepare /data/scans -o /shared/scans --rank 3 --world-size 8       one of eight machines
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.add_argument("source", help="of scans: NAME:ROOT:SPLIT, a folder, simulated:COUNT")
    parser.add_argument("-o", "--out", type=Path, help="a folder that train and evaluate take as a source")
    parser.add_argument("--sensor", help="name or .json file (default: the data set's)")
    parser.add_argument("--columns", type=int, default=0, help="fine columns of the circle (default: the sensor's)")
    parser.add_argument("--column-stride", type=int, default=1, help="of which every n-th is the image's")
    parser.add_argument("--projection", choices=["sensor", "spherical", "unfolding"], default="sensor")
    parser.add_argument("--projection-variant", choices=["exact", "reference"], default="exact")
    parser.add_argument("-n", "--max-scans", type=int, default=0, help="evenly spaced; 0 for all")
    parser.add_argument("--bad-points", choices=["refuse", "drop"], default="refuse", help="NaN, infinite or at 0")
    parser.add_argument("--bad-scans", choices=["refuse", "skip"], default="refuse", help="that cannot be used")
    parser.add_argument("--workers", type=int, default=2, help="processes on this machine")
    parser.add_argument("--rank", type=int, help="which machine this is, from 0")
    parser.add_argument("--world-size", type=int, help="of how many")
    parser.add_argument("--verify", action="store_true", help="also read everything back, and remake what is damaged")
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Prepare, and say what was made."""
    from lidargrit.datasets import open_dataset
    from lidargrit.loading import DataConfig, prepare_and_describe
    from lidargrit.reporting import TerminalReporter

    refuse_taken(options)
    config = DataConfig(
        sensor=options.sensor or open_dataset(options.source, options.bad_points).sensor,
        columns=options.columns,
        column_stride=options.column_stride,
        projection=options.projection,
        projection_variant=options.projection_variant,
        max_scans=options.max_scans,
        bad_points=options.bad_points,
        bad_scans=options.bad_scans,
        workers=options.workers,
    )
    reporter, place = TerminalReporter(), (options.rank, options.world_size)
    made = prepare_and_describe(options.source, config, options.out, reporter, *place, verify=options.verify)
    tell(options, made.as_line(), made.to_json())
