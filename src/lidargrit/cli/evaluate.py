"""Score samples or simulated streets against real scans."""

import argparse
from pathlib import Path

from lidargrit.cli._evaluation import evaluated
from lidargrit.cli._options import add_count, add_device, add_ray, add_scans
from lidargrit.cli._results import add_json, files_told, print_result, refuse_taken
from lidargrit.core.untrusted import WholeNumber, seed_number

EXAMPLES = """\
  lidargrit evaluate samples /data/held_out --report report.html
  lidargrit evaluate samples kitti_360:/data/kitti_360:test --protocol lidargrit-kitti-360 --json scores.json
  lidargrit evaluate r2dm_samples kitti_360:/data/kitti_360 --protocol r2dm --weights pointnet=cls_model_39.pth
  lidargrit evaluate simulated:32:test /data/held_out --protocol streets --report curves.png    the simulator
  lidargrit evaluate kitti_360:/data/kitti_360:test --protocol r2dm --save-reference test.lgref    scores need no data
  lidargrit evaluate drives --protocol forecast    each scan of a drive from the five before it
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    samples = "samples (.pth of others, too), or a source of scans"
    add("samples", nargs="?", default="", help=samples)
    reference = "scans to compare with, projected with the sensor of the samples; or their .lgref"
    add("reference", nargs="?", default="", help=reference)
    add("--protocol", default="exact", metavar="NAME", help="metrics and definitions: lidargrit list protocols")
    add("--metrics", nargs="+", default=[], metavar="NAME", help="others than the protocol's: lidargrit list metrics")
    add("--variant", default="", metavar="NAME", help="published definition of every metric")
    add("--samples-format", default="", metavar="NAME", help="program that wrote them: lidargrit list sample-formats")
    add("--weights", nargs="+", default=[], metavar="NAME=FILE", help="weights of pointnet and rangenet53")
    add_count(parser, help="largest number of scans; 0 for the protocol's")
    add("--intervals", type=int, default=20, metavar="B", help="half-samples for 95 %% intervals; 0 for none")
    add("--pixel-statistics", action="store_true", help="also score pixel statistics, which models must beat")
    add("--groups", type=WholeNumber(4), default=16, metavar="G", help="groups of scans in half-samples")
    add("--seed", type=seed_number, default=0, metavar="N", help="seed of all random choices")
    add_device(parser)
    add_ray(parser)
    add_scans(parser)
    add("--model", default="", metavar="RUN", help="model of raydrop (streets) or of drives (forecast)")
    add("--beside", default="", metavar="SCANS", help="scans of another real drive, compared too (streets)")
    kept = "keep what others need to score against SAMPLES, which are real scans (.lgref)"
    add("--save-reference", type=Path, metavar="FILE", help=kept)
    add("--report", type=Path, metavar="FILE", help="also write a page (.html), of streets a picture (.png)")
    add_json(parser, "the files of --json, --report and --save-reference")


def run(options: argparse.Namespace) -> None:
    refuse_taken(options, replaces_others=True)
    text, values, also = evaluated(options)
    found = {"facts" if options.save_reference else "scores": options.json}
    print_result(options, text, values, files_told(**found, report=options.report), also)
