"""Show scans, samples and runs side by side on one scale, as a PNG or a page to turn and step through."""

import argparse
from pathlib import Path

from lidargrit.cli._options import add_count, add_device, add_scans, scan_settings
from lidargrit.core.untrusted import PAGE_SCANS_AT_MOST, WholeNumber, seed_number

EXAMPLES = """\
  lidargrit view /data/scans                           range image, return mask and bird's-eye view
  lidargrit view /data/held_out runs/demo -o all.png   real, reconstructed and generated
  lidargrit view samples /data/held_out -o all.html -n 12       a page to turn, zoom and step through
  lidargrit view /data/scans --color anomaly           pixels that a model did not expect
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("scans", nargs="+", metavar="SCANS", help="source of scans: a file, a folder, samples, or a run")
    out = "picture (.png) or interactive page (.html) to write"
    add("-o", "--out", type=Path, default=Path("view.png"), help=out)
    add_count(parser, 3, "number of scans of each", WholeNumber(1, PAGE_SCANS_AT_MOST))
    add("--seed", type=seed_number, default=0, help="seed of the first generated scan")
    colour = "colour of pixels: range, or anomaly for the bits beyond those expected"
    add("--color", choices=["range", "anomaly"], default="range", help=colour)
    model = "run whose likelihood gives the anomaly; needs a pixel decoder (default: pretrained)"
    add("--model", default="", help=model)
    add_scans(parser)
    add_device(parser)
    add("--overwrite", action="store_true", help="replace the file if it exists")


def run(options: argparse.Namespace) -> None:
    from lidargrit.core.errors import ConfigError
    from lidargrit.core.files import refuse_to_overwrite
    from lidargrit.viewer import view

    if options.model and options.color != "anomaly":
        raise ConfigError(
            f"--model {options.model} with --color range", "--color anomaly", "add it, or leave --model out"
        )
    refuse_to_overwrite(options.out, options.overwrite, ".png", ".html")
    named = (options.scans, options.out, options.count, options.seed, scan_settings(options))
    view(*named, (options.model or "pretrained") if options.color == "anomaly" else "", options.device)
    print(f"done: look at {options.out}")
