"""Sample new scans from a trained run; the same command goes on where it stopped."""

import argparse
import os
from pathlib import Path

from lidargrit.cli._options import add_device, add_rank, add_ray, add_settings, ray_address, sampling_words, sensor_of
from lidargrit.cli._results import look_at
from lidargrit.core.errors import counted_scans
from lidargrit.core.untrusted import WholeNumber, seed_number, seeds_in_a_row, whole_number

EXAMPLES = """\
  lidargrit sample pretrained samples                     by a model that comes with the package, 64x256
  lidargrit sample runs/any mine --sensor mine.json       by a run of the preset multiscale_any
  lidargrit sample pretrained drives -n 2 --frames 100 --path poses.txt           two drives of ten seconds
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(goes_on=True)
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="a finished run, pretrained or pretrained_wide")
    parser.add_argument("out", type=Path, help="folder for the samples; the same command continues there")
    parser.add_argument("-n", "--count", type=WholeNumber(1), default=16, help="number of scans")
    parser.add_argument("--seed", type=seed_number, default=0, help="seed of the first scan; the next has the next")
    parser.add_argument("--sensor", default="", help="name or .json of another sensor, for a run that takes any")
    parser.add_argument("--frames", type=whole_number, default=0, metavar="N", help="scans in a row of each drive")
    parser.add_argument("--path", type=Path, help="poses of a drive: TUM's rows, or a KITTI sequence (else straight)")
    add_settings(parser, "settings of sampling, such as sampling.temperature=1.1; see: lidargrit list generators")
    add_rank(parser, "process")
    add_ray(parser)
    add_device(parser)


def run(options: argparse.Namespace) -> None:
    import torch

    from lidargrit.core.processes import rank_and_world_size
    from lidargrit.data.run_folder import locate
    from lidargrit.generation.generator import load
    from lidargrit.inference.drives import opening_of, path_of, write_drives
    from lidargrit.inference.samples import write_samples, write_samples_on_ray

    seeds, job = seeds_in_a_row(options.seed, options.count), "drive" if options.frames else "sample"
    address, words, sensor = ray_address(options), sampling_words(options.set), sensor_of(options)
    if address:
        write_samples_on_ray(locate(options.run_folder), options.out, seeds, words, address, options.device)
    else:
        rank, world_size = rank_and_world_size(options.rank, options.world_size)
        own = f"cuda:{os.environ.get('LOCAL_RANK', '0')}" if torch.cuda.is_available() else "cpu"
        run_folder, device = locate(options.run_folder, job), options.device or own
        generator, seeds = load(run_folder, device=device), seeds[rank::world_size]
        generator = generator.for_sensor(sensor or generator.sensor)
        sampling = generator.parse_sampling(words)
        if options.frames:
            first = opening_of(options.run_folder, device)
            ways = [path_of(options.frames, options.path)] * len(seeds)
            write_drives(generator, run_folder, options.out, ways, seeds, sampling, first, path=str(options.path))
        else:
            write_samples(generator, run_folder, options.out, seeds, sampling)
    print(f"done: {counted_scans(len(seeds) * max(1, options.frames))} in {options.out}; {look_at(options.out)}")
