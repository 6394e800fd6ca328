"""Say what a projection keeps of a scan, what it loses, and how far off it puts the rest."""

from __future__ import annotations

import argparse
from pathlib import Path

from lidargrit.cli._options import add_bad_points, add_projection_variant
from lidargrit.cli._results import add_json, print_result, refuse_taken

EXAMPLES = """\
  lidargrit inspect scan.bin                                     with the sensor of ours that looks closest
  lidargrit inspect /data/kitti_odometry --projection spherical  the first scan of a data set
  lidargrit inspect scan.bin --sensor vlp16 -o picture.png --json figures.json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.add_argument("scan", help="file of a scan, or a source of scans whose first scan is inspected")
    sensor = "name or .json file of the sensor (default: the data set's, or the known sensor that fits best)"
    parser.add_argument("--sensor", help=sensor)
    parser.add_argument("--columns", type=int, help="number of columns of the full circle (default: the sensor's)")
    rows = "rows by elevation (spherical) or by ring (unfolding) (default: the sensor's own)"
    parser.add_argument("--projection", choices=["spherical", "unfolding"], help=rows)
    add_projection_variant(parser, "--variant")
    add_bad_points(parser)
    parser.add_argument("-o", "--out", type=Path, metavar="PNG", help="also plot the range image and what is lost")
    add_json(parser, "the files of --out and --json")


def run(options: argparse.Namespace) -> None:
    """Project one scan and print what became of it."""
    from lidargrit.api import load_scan
    from lidargrit.files import refuse_to_overwrite
    from lidargrit.projection.fit import closest_sensor
    from lidargrit.projection.inspection import as_json, as_table, inspect
    from lidargrit.sensors import load_sensor
    from lidargrit.sources import open_source
    from lidargrit.viewer.inspection import plot_inspection

    refuse_to_overwrite(options.out, options.overwrite, ".png")
    refuse_taken(options)
    name = options.sensor
    if Path(options.scan).is_file():
        scan = load_scan(options.scan, bad_points=options.bad_points)
    else:
        dataset = open_source(options.scan, options.bad_points).scans()
        scan = dataset.scan(0)
        name = name or dataset.sensor
    sensor = load_sensor(name or closest_sensor(scan))
    if options.columns is not None:
        sensor = sensor.with_columns(options.columns)
    found = inspect(scan, sensor, options.projection, options.projection_variant)
    if options.out:
        plot_inspection(found, options.out)
    print_result(options, as_table(found), as_json(found), f"\ndone: look at {options.out}" if options.out else "")
