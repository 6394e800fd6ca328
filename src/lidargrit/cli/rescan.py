"""Turn scans into those that another sensor, or another mounting, would have made of the same place."""

import argparse
from pathlib import Path

from lidargrit.cli._options import add_count, add_scans, scan_settings
from lidargrit.cli._results import look_at
from lidargrit.core.errors import counted_scans
from lidargrit.core.untrusted import RAISED_AT_MOST_M, Number

EXAMPLES = """\
  lidargrit rescan kitti_odometry:/data/kitti:00 sparse --to vlp16              64 rows to 16
  lidargrit rescan /data/scans low --sensor os1_128 --to os1_64 --raised-m -0.5
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(goes_on=True)
    parser.add_argument("scans", help="scans: a file, a folder, NAME:ROOT:SPLIT or simulated:COUNT")
    parser.add_argument("out", type=Path, help="folder for the files: empty, or begun by the same command")
    parser.add_argument("--to", required=True, help="name or .json file of the sensor whose scans are wanted")
    raised = "height of the wanted sensor above the one that made the scans, in metres"
    parser.add_argument("--raised-m", type=Number(-RAISED_AT_MOST_M, RAISED_AT_MOST_M), default=0.0, help=raised)
    formats = "format of the files: bin, pcd, ply, las, npz, or kitti_odometry for a tree with labels"
    parser.add_argument("--format", default="kitti_bin", help=formats)
    add_count(parser)
    add_scans(parser)


def run(options: argparse.Namespace) -> None:
    from lidargrit.data.export import export_scans
    from lidargrit.data.sources import open_source
    from lidargrit.data.sources.scan_sensor import sensor_for
    from lidargrit.scans.rescan import Rescan
    from lidargrit.scans.sensors import load_sensor

    other = load_sensor(options.to)
    settings = scan_settings(options, max_scans=options.count)
    source = open_source(options.scans, settings.data.bad_points)
    change = Rescan(sensor_for(source, settings.sensor), other, options.raised_m)
    count = export_scans(options.scans, options.out, options.format, settings.data, change=change)
    print(f"done: {counted_scans(count)} in {options.out}; {look_at(options.out)}")
