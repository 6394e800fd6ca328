"""Simulate scans of streets as files in the layout of KITTI odometry, with labels and poses."""

import argparse
from pathlib import Path

from lidargrit.cli._options import add_ray
from lidargrit.core.errors import counted_scans
from lidargrit.core.untrusted import FRAMES_AT_MOST, Number, WholeNumber, process_count, seed_number

EXAMPLES = """\
  lidargrit simulate streets -n 1000
  lidargrit simulate drives -n 200 --frames 20                 ten drives of two seconds
  lidargrit simulate clean_and_dropped -n 500 --clean          to train and judge raydrop models
  lidargrit simulate vlp16 -n 100 --sensor vlp16 --theme city --wet 0.5
"""
_SENSOR = "hdl64e_kitti_odometry"  # of the data set whose layout is written


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(goes_on=True)
    add = parser.add_argument
    add("out", type=Path, help="folder for the scans: empty, or begun by the same command")
    add("-n", "--count", type=WholeNumber(1), required=True, help="number of scans in all")
    add("--sensor", default=_SENSOR, help="name or .json file of the sensor")
    seed = "seed of the first street; each next street has the next seed"
    add("--seed", type=seed_number, default=0, help=seed)
    frames = f"scans of each street, 0.1 s apart; up to {FRAMES_AT_MOST:,}"
    add("--frames", type=WholeNumber(1, FRAMES_AT_MOST), default=1, help=frames)
    add("--theme", choices=["mixed", "city", "suburb", "country"], default="mixed", help="kind of streets")
    add("--motion", action="store_true", help="keep the distortion that the car's own motion causes")
    add("--wet", type=Number(0.0, 1.0), default=0.0, help="wetness of the ground, from 0 (dry) to 1")
    add("--clean", action="store_true", help="also write clean ranges and return probabilities, as .npz")
    add("--workers", type=process_count, default=2, help="number of processes")
    add_ray(parser)


def run(options: argparse.Namespace) -> None:
    from lidargrit.data.drives import DriveConfig, write_drives
    from lidargrit.scans.sensors import load_sensor

    settings = {name: vars(options)[name] for name in ("seed", "frames", "theme", "motion", "wet", "clean")}
    config = DriveConfig(load_sensor(options.sensor), **settings)
    there = write_drives(options.out, options.count, config, options.workers, options.ray)
    print(f"{counted_scans(there)} in {options.out}: read them as kitti_odometry:{options.out}")
