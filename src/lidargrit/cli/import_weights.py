"""Make a run of the weights that a system's authors published: their .pth files → a run folder."""

from __future__ import annotations

import argparse
from pathlib import Path

EXAMPLES = """\
  lidargrit import-weights lidargrit_kitti_360 runs/published vqvae.pth transformer.pth \\
      --set data.projection_variant=reference data.columns=2048 data.column_stride=2
  lidargrit import-weights r2dm_kitti_360 runs/r2dm r2dm-h-kitti360-300k.pth
  lidargrit import-weights dusty_kitti_odometry runs/dusty dusty1.pth
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.add_argument(
        "recipe", help="whose generator, sizes and sensor the weights have; see: lidargrit list recipes"
    )
    parser.add_argument("out", type=Path, help="run folder, which sample, evaluate and view take")
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE", help="for lidargrit the VQ-VAE's first")
    settings = "change settings of the recipe"
    parser.add_argument("--set", nargs="+", action="extend", default=[], metavar="NAME=VALUE", help=settings)


def run(options: argparse.Namespace) -> None:
    """Import, and say what was found."""
    from lidargrit.publishing import import_weights

    generator = import_weights(options.recipe, options.out, options.files, options.set)
    weights = sum(weight.numel() for weight in generator.parameters())
    print(f"done: {weights:,} weights of {generator.public_name()} for {generator.sensor.name} lie in {options.out}")
    print(f"sample them with: lidargrit sample {options.out} samples -n 16")
