"""Import the weights that a system's authors published: .pth files → a run folder."""

import argparse
from pathlib import Path

from lidargrit.cli._options import add_settings

EXAMPLES = """\
  lidargrit import-weights lidargrit_kitti_360 runs/published vqvae.pth transformer.pth \\
      --set data.projection_variant=reference data.columns=2048 data.column_stride=2
  lidargrit import-weights r2dm_kitti_360 runs/r2dm r2dm-h-kitti360-300k.pth
  lidargrit import-weights lidargen_kitti_360 runs/lidargen checkpoint.pth
  lidargrit import-weights lidargan_kitti_odometry runs/lidargan gen_999.pth
  lidargrit import-weights r2flow_kitti_360 runs/r2flow r2flow-kitti360-1rf.pth
  lidargrit import-weights ultralidar_kitti_360 runs/ultralidar epoch_200.pth
  lidargrit import-weights lidm_kitti_360 runs/lidm model.ckpt
  lidargrit import-weights dusty_kitti_odometry runs/dusty dusty1.pth
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    preset = "preset with the generator, sizes and sensor of the weights; see: lidargrit list presets"
    add("preset", help=preset)
    add("out", type=Path, help="run folder to write, for: lidargrit sample, evaluate and view")
    files = "published weight files; for lidargrit the VQ-VAE's first, then the transformer's"
    add("files", type=Path, nargs="+", metavar="FILE", help=files)
    add_settings(parser, "settings of the preset to change")


def run(options: argparse.Namespace) -> None:
    from lidargrit.publishing import import_weights

    generator = import_weights(options.preset, options.out, options.files, options.set)
    weights = sum(weight.numel() for weight in generator.parameters())
    print(f"done: {weights:,} weights of {generator.public_name()} for {generator.sensor.name} lie in {options.out}")
    print(f"sample them with: lidargrit sample {options.out} samples -n 16")
