"""Show which points a projection keeps, which it loses, and how far it moves those that it keeps."""

import argparse
from pathlib import Path

from lidargrit.cli._options import add_scans, scan_settings
from lidargrit.cli._results import add_json, print_result, refuse_taken

EXAMPLES = """\
  lidargrit inspect scan.bin                                     with the sensor of ours that looks closest
  lidargrit inspect /data/kitti_odometry --projection spherical  the first scan of a data set
  lidargrit inspect scan.bin --sensor vlp16 -o picture.png --json inspection.json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scans", help="file of a scan, or a source of scans whose first scan is inspected")
    add_scans(parser)
    parser.add_argument("-o", "--out", type=Path, metavar="PNG", help="also plot the range image and what is lost")
    add_json(parser, "the files of --out and --json")


def run(options: argparse.Namespace) -> None:
    from lidargrit.core import reporting
    from lidargrit.core.files import refuse_to_overwrite
    from lidargrit.data.sources.named import first_scan
    from lidargrit.scans.projection.inspection import as_json, as_table, inspect
    from lidargrit.scans.projection.sensor_check import closest_sensor, projection_that_fits
    from lidargrit.scans.sensors import load_sensor
    from lidargrit.viewer.inspection import plot_inspection

    refuse_to_overwrite(options.out, options.overwrite, ".png")
    refuse_taken(options, replaces_others=True)
    settings = scan_settings(options)
    scan, of_data_set = first_scan(options.scans, settings.data)
    name = settings.sensor or of_data_set or closest_sensor(scan)
    sensor, method = settings.data.with_projection(load_sensor(name)), None
    if settings.data.projection == "sensor" and (method := projection_that_fits(scan, sensor)) != sensor.projection:
        reporting.message("points that are not in firing order, so rows go by elevation")
    found = inspect(scan, sensor, method, settings.data.projection_variant)
    if options.out:
        plot_inspection(found, options.out)
    print_result(options, as_table(found), as_json(found), f"\ndone: look at {options.out}" if options.out else "")
