"""Write scans or samples as point clouds for other programs, as a KITTI tree, or as recordings for viewers."""

import argparse
from pathlib import Path

from lidargrit.cli._options import add_count, add_scans, scan_settings
from lidargrit.core.errors import counted_scans

EXAMPLES = """\
  lidargrit export samples clouds --format pcd                what a model generated, a file a scan
  lidargrit export samples tree --format kitti_odometry       sequences/00/velodyne/000000.bin, ...
  lidargrit export simulated:100 streets --format ply         with labels and rings
  lidargrit export kitti_raw:/data/kitti_raw las -n 20 --format las
  lidargrit export drives recordings --format mcap            one file a drive, with its times and poses
  lidargrit export drive.mcap still --format pcd --undo-motion poses.txt     as if the car had stood still
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(goes_on=True)
    parser.add_argument("scans", help="samples, prepared scans, or scans: a folder, NAME:ROOT:SPLIT or simulated:COUNT")
    parser.add_argument("out", type=Path, help="folder for the files: empty, or begun by the same command")
    formats = "bin, pcd, ply, las, npz, a name from: lidargrit list formats, kitti_odometry for a tree with labels, "
    parser.add_argument("--format", default="kitti_bin", help=formats + "mcap or rrd for a recording of each drive")
    add_count(parser)
    sensor = "name or .json file of the sensor, for range images in .npy files"
    parser.add_argument("--sensor", default="", help=sensor)
    poses = "poses of the lidar, to undo its motion: a file of time x y z qx qy qz qw, or KITTI's folder of a sequence"
    parser.add_argument("--undo-motion", type=Path, metavar="POSES", help=poses)
    add_scans(parser, projects=False)


def run(options: argparse.Namespace) -> None:
    from lidargrit.data.export import export_scans
    from lidargrit.data.recordings import KINDS
    from lidargrit.data.trajectories import read_trajectory
    from lidargrit.scans.sensors import load_sensor
    from lidargrit.scans.undo_motion import UndoMotion

    config = scan_settings(options, max_scans=options.count).data
    sensor = config.with_projection(load_sensor(options.sensor)) if options.sensor else None
    change = UndoMotion(read_trajectory(options.undo_motion)) if options.undo_motion else None
    count = export_scans(options.scans, options.out, options.format, config, sensor, change)
    what = f"{count} {'recording' if count == 1 else 'recordings'}" if options.format in KINDS else counted_scans(count)
    print(f"done: {what} in {options.out}; export.json says which file holds which scan")
