"""Project scans once: range images in compressed shards, by many processes, taken up again where stopped."""

from __future__ import annotations

import argparse
from pathlib import Path

from lidargrit.cli._options import add_bad_scans, add_projection_variant, add_rank
from lidargrit.cli._results import add_json, print_result, refuse_taken

EXAMPLES = """\
  lidargrit prepare kitti_360:/data/KITTI-360:train -o /fast/kitti_360_train --workers 16
  lidargrit train lidargrit_kitti_360 runs/mine --set data.train=/fast/kitti_360_train data.val=...
  lidargrit prepare /data/my_scans --sensor my_sensor.json       into the cache, where train finds it
  lidargrit prepare /data/scans -o /shared/scans --rank 3 --world-size 8       one of eight machines
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.add_argument("source", help="scans: a folder, NAME:ROOT:SPLIT or simulated:COUNT")
    out = "folder for the range images, a source for train and evaluate (default: in the cache)"
    parser.add_argument("-o", "--out", type=Path, help=out)
    parser.add_argument("--sensor", help="name or .json file of the sensor (default: the data set's)")
    columns = "number of columns of the full circle (default: the sensor's)"
    parser.add_argument("--columns", type=int, default=0, help=columns)
    parser.add_argument("--column-stride", type=int, default=1, help="keep every n-th of the columns")
    rows = "rows by elevation (spherical) or by ring (unfolding) (default: the sensor's own)"
    parser.add_argument("--projection", choices=["sensor", "spherical", "unfolding"], default="sensor", help=rows)
    add_projection_variant(parser)
    parser.add_argument("-n", "--max-scans", type=int, default=0, help="number of scans, evenly spaced; 0 for all")
    add_bad_scans(parser)
    parser.add_argument("--workers", type=int, default=2, help="number of processes on this machine")
    add_rank(parser, "machine")
    parser.add_argument("--verify", action="store_true", help="also read all back, and prepare damaged parts anew")
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Prepare, and say what was made."""
    from lidargrit.loading import DataConfig, prepare_and_describe
    from lidargrit.reporting import TerminalReporter
    from lidargrit.sources import open_source

    refuse_taken(options)
    dataset = open_source(options.source, options.bad_points).scans()
    config = DataConfig(
        sensor=options.sensor or dataset.sensor,
        columns=options.columns,
        column_stride=options.column_stride,
        projection=options.projection,
        projection_variant=options.projection_variant,
        max_scans=options.max_scans,
        bad_points=options.bad_points,
        bad_scans=options.bad_scans,
        workers=options.workers,
    )
    reporter, machines = TerminalReporter(), (options.rank, options.world_size)
    made = prepare_and_describe(options.source, dataset, config, options.out, reporter, *machines, options.verify)
    print_result(options, made.as_text(), made.to_json())
