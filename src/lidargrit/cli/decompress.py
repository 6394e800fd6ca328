"""Restore what lidargrit compress wrote, range images or points; a damaged file is refused."""

import argparse
from pathlib import Path

from lidargrit.cli._results import look_at
from lidargrit.core.errors import counted_scans
from lidargrit.core.untrusted import whole_number

EXAMPLES = """\
  lidargrit decompress scans.lgz restored                    range images in metres as .npy
  lidargrit decompress scans.lgz clouds --format pcd         points on the rays of the pixels
  lidargrit decompress scans.lgz two --only 0 17 --model runs/mine
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(goes_on=True)
    add = parser.add_argument
    add("file", type=Path, metavar="FILE.lgz", help="file that lidargrit compress wrote")
    add("out", type=Path, help="folder for the scans: empty, or begun by the same command")
    add("--model", help="run by which it was compressed (default: pretrained)")
    kind = "image for range images (H, W) in metres as .npy (default; of --points: bin), or bin, pcd, ply, npz, or a "
    add("--format", help=kind + "name from: lidargrit list formats")
    only = "indices of the scans that are wanted, from 0; all if not given"
    add("--only", nargs="+", type=whole_number, default=[], metavar="INDEX", help=only)


def run(options: argparse.Namespace) -> None:
    from lidargrit.inference.compress.command import decompress_scans

    named = (options.file, options.out, options.model, options.format, options.only)
    count = decompress_scans(*named)
    print(f"done: {counted_scans(count)} in {options.out}; {look_at(options.out)}")
