"""Compress range images to a few bits a return with a model, or all points of scans without one, to a step."""

import argparse
from pathlib import Path

from lidargrit.cli._options import add_count, add_ray, add_scans, add_step, refuse_unused, scan_settings
from lidargrit.core.errors import counted_scans

EXAMPLES = """\
  lidargrit compress /data/kitti_odometry scans.lgz
  lidargrit compress /data/scans fine.lgz --step-mm 2 --model runs/mine
  lidargrit compress /data/drive drive.lgz --model pretrained/forecaster      each scan given those before it
  lidargrit compress /data/drive points.lgz --points --step-mm 20     every point, within 1 cm along each axis
  lidargrit decompress fine.lgz restored --model runs/mine
"""
_OF_POINTS = ("scans", "points", "step_mm", "count", "bad_points", "bad_scans", "set")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(goes_on=True)
    add = parser.add_argument
    add("scans", help="scans: a file, a folder, NAME:ROOT:SPLIT, samples, prepared scans, or range images as .npy")
    add("out", type=Path, metavar="OUT.lgz", help="file to write")
    add("--model", default="pretrained", help="run with a pixel decoder (default: pretrained)")
    add_step(parser, "ranges, or coordinates, change by half of it at most")
    add("--points", action="store_true", help="keep all points and reflectance, by no model")
    add_count(parser)
    add_scans(parser)
    add_ray(parser)
    add("--overwrite", action="store_true", help="replace the file if it exists")


def run(options: argparse.Namespace) -> None:
    from lidargrit.core.files import refuse_to_overwrite
    from lidargrit.data.sources.scan_sensor import sensor_for_run
    from lidargrit.inference.compress.command import compress_scans
    from lidargrit.inference.compress.points_command import compress_points

    refuse_to_overwrite(options.out, options.overwrite, ".lgz")
    settings, each = scan_settings(options, max_scans=options.count), "point" if options.points else "return"
    if options.points:
        refuse_unused(options, "with --points", _OF_POINTS)
        found = compress_points(options.scans, options.out, options.step_mm, settings.data)
    else:
        named = (options.scans, options.out, options.model, options.step_mm)
        sensor = sensor_for_run(settings, options.scans, options.model)
        found = compress_scans(*named, settings.data, options.ray, sensor)
    size = f"{found.num_bytes:,} bytes, {found.bits_per_return:.2f} bits a {each} in steps of {options.step_mm} mm"
    print(f"done: {counted_scans(found.num_scans)} in {options.out}: {size}")
