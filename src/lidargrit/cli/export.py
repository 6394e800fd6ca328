"""Write scans or samples as point clouds for other programs, or as a KITTI tree."""

from __future__ import annotations

import argparse
from pathlib import Path

EXAMPLES = """\
  lidargrit export samples clouds --format pcd                what a model drew, a file a scan
  lidargrit export samples tree --format kitti_odometry       sequences/00/velodyne/000000.bin, ...
  lidargrit export simulated:100 streets --format ply         with labels and rings
  lidargrit export kitti_raw:/data/kitti_raw las -n 20 --format las
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.add_argument("source", help="samples, prepared scans, or scans: NAME:ROOT:SPLIT, a folder, simulated:COUNT")
    parser.add_argument("out", type=Path, help="an empty folder, or one that the same command began")
    parser.add_argument(
        "--format",
        default="kitti_bin",
        help="bin, pcd, ply, las, npz, a name of: lidargrit list formats, or kitti_odometry for a tree with "
        "SemanticKITTI's labels (default: kitti_bin)",
    )
    parser.add_argument("-n", "--max-scans", type=int, default=0, help="0 for all")
    parser.add_argument("--bad-points", choices=["refuse", "drop"], default="refuse", help="NaN, infinite or at 0")
    parser.add_argument("--bad-scans", choices=["refuse", "skip"], default="refuse", help="that cannot be used")


def run(options: argparse.Namespace) -> None:
    """Write the files, and say how many."""
    from lidargrit.export import export_scans
    from lidargrit.loading import DataConfig
    from lidargrit.reporting import TerminalReporter

    config = DataConfig(max_scans=options.max_scans, bad_points=options.bad_points, bad_scans=options.bad_scans)
    count = export_scans(options.source, options.out, options.format, config, TerminalReporter())
    print(f"done: {count} scans in {options.out}; which is which is told by export.json")
