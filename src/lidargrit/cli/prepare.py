"""Project scans once: range images in compressed shards, by many processes, taken up again where stopped."""

import argparse
from dataclasses import replace
from pathlib import Path

from lidargrit.cli._options import add_count, add_rank, add_ray, add_scans, ray_address, scan_settings
from lidargrit.cli._results import add_json, print_result, refuse_taken
from lidargrit.core.untrusted import process_count

EXAMPLES = """\
  lidargrit prepare kitti_360:/data/KITTI-360:train -o /fast/kitti_360_train --workers 16
  lidargrit train lidargrit_kitti_360 runs/mine --set data.train=/fast/kitti_360_train data.val=...
  lidargrit prepare /data/my_scans --sensor my_sensor.json       into the cache, where train finds it
  lidargrit prepare /data/scans -o /shared/scans --rank 3 --world-size 8       one of eight machines
  lidargrit prepare /data/scans -o /shared/scans --ray auto                    all machines of a Ray cluster
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(goes_on=True)
    parser.add_argument("scans", help="scans: a folder, NAME:ROOT:SPLIT or simulated:COUNT")
    out = "folder for the range images, a source for train and evaluate (default: in the cache)"
    parser.add_argument("-o", "--out", type=Path, help=out)
    add_count(parser)
    add_scans(parser)
    parser.add_argument("--workers", type=process_count, help="number of processes on this machine (default: 2)")
    add_rank(parser, "machine")
    add_ray(parser)
    parser.add_argument("--verify", action="store_true", help="also read all back, and prepare damaged parts anew")
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    from lidargrit.data.prepared.prepare import prepare_and_describe
    from lidargrit.data.sources import open_source

    refuse_taken(options)
    address = ray_address(options)
    machines = (options.rank, options.world_size)
    settings = scan_settings(options, max_scans=options.count, workers=options.workers)
    source = open_source(options.scans, settings.data.bad_points)
    dataset = source.scans()
    config = replace(settings.data, sensor=settings.sensor or source.sensor_name)
    made = prepare_and_describe(options.scans, dataset, config, options.out, *machines, options.verify, address)
    print_result(options, made.as_text(), made.to_json())
