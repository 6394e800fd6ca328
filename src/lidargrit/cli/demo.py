"""Do everything once: scans, training, new scans, scores, and one page that shows them."""

import argparse
from pathlib import Path

from lidargrit.cli._options import add_scans, scan_words

EXAMPLES = """\
  lidargrit demo                                simulated streets, some minutes on two cores
  lidargrit demo --data /data/kitti_odometry    your own scans: a KITTI tree, or any folder of .bin
  lidargrit demo --anew --out runs/demo_anew    all networks trained anew, about ten minutes
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(goes_on=True)
    parser.add_argument("--data", metavar="SOURCE", help="folder of scans (default: simulated scans)")
    parser.add_argument("--out", type=Path, help="run folder (default: runs/demo, or runs/demo-FOLDER)")
    anew = "train all networks anew (default: begin with those of the model pretrained, if it has your sensor)"
    parser.add_argument("--anew", action="store_true", help=anew)
    settings = "settings of the preset to change"
    add_scans(parser, settings)


def run(options: argparse.Namespace) -> None:
    from lidargrit.data.datasets import root_of
    from lidargrit.viewer.demo import PAGE, demo

    out = options.out or Path("runs") / (f"demo-{root_of(options.data).resolve().name}" if options.data else "demo")
    folder = demo(options.data, out, scan_words(options), options.anew)
    print(f"done: look at {folder / PAGE}; everything lies in {folder}")
