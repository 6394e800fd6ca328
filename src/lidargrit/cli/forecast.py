"""Forecast the scans that follow in a drive, one after the other; the same command goes on where it stopped."""

import argparse
from pathlib import Path

from lidargrit.cli._options import add_device, add_settings, sampling_words
from lidargrit.cli._results import look_at
from lidargrit.core.errors import counted_scans
from lidargrit.core.untrusted import WholeNumber, seed_number, whole_number

EXAMPLES = """\
  lidargrit forecast kitti_odometry:/data/kitti_odometry:00 next       ten scans after its last
  lidargrit forecast drives:00 next --model runs/forecaster --after 5 -n 20 --constant-speed
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(goes_on=True)
    add = parser.add_argument
    add("drive", help="source of the scans of a drive with times and poses")
    add("out", type=Path, help="folder for the scans; the same command continues there")
    add("--model", type=Path, default=Path("pretrained"), help="a finished run that takes a past (default: pretrained)")
    add("-n", "--count", type=WholeNumber(1), default=10, metavar="N", help="number of scans")
    add("--after", type=whole_number, metavar="SCAN", help="number of the last scan that is seen, from 0")
    add("--constant-speed", action="store_true", help="repetition of the last step, though later poses are known")
    add("--seed", type=seed_number, default=0, help="seed of the drive")
    add_settings(parser, "settings of sampling, such as sampling.range_noise=1")
    add_device(parser)


def run(options: argparse.Namespace) -> None:
    from lidargrit.data.run_folder import locate
    from lidargrit.generation.generator import load
    from lidargrit.inference.drives import continued, write_drives

    run_folder = locate(options.model, "drive")
    generator = load(run_folder, device=options.device)
    way = continued(options.drive, generator, options.count, options.after, options.constant_speed)
    sampling = generator.parse_sampling(sampling_words(options.set))
    facts = {name: vars(options)[name] for name in ("drive", "after", "constant_speed")}
    count = write_drives(generator, run_folder, options.out, [way], [options.seed], sampling, **facts)
    print(f"done: {counted_scans(count)} in {options.out}; {look_at(options.out)}")
