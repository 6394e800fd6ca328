"""Learn how much noise the pixels of a finished run's masks share: all other weights stay → a run's folder, a table.

    python benchmarks/phase_noise.py pretrained shared --scans simulated:400:train
    python benchmarks/phase_noise.py pretrained/raydrop shared --stage raydrop --scans simulated_surfaces:400:train

Runs that were trained before masks shared noise get it in this way; others learn it while they train.
"""

import argparse
import shutil
from pathlib import Path

import torch

from lidargrit.core.files import read_tensors
from lidargrit.data.run_folder import RUN_FILE, WEIGHTS_FILE, locate, trained_on_file
from lidargrit.data.sources import open_images
from lidargrit.generation.generator import load
from lidargrit.generation.pixel_decoder.mask_network import MaskNetwork
from lidargrit.generation.pixel_decoder.phase_noise import PhaseNoise
from lidargrit.scans.example import Example

_AT_ONCE = 4


@torch.no_grad()
def main() -> None:
    """Take scans through the stage's objective as training does, keep what its noise learned, and print the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="finished run with the stage")
    parser.add_argument("out", type=Path, help="folder for the weights with the shares: one that is not there yet")
    parser.add_argument("--stage", choices=["pixels", "raydrop", "completion"], default="pixels")
    parser.add_argument(
        "--scans", default="simulated:400:train", help="source of training scans (default: %(default)s)"
    )
    options = parser.parse_args()
    model = load(options.run)
    if options.stage not in model.stages:
        parser.error(f"{options.run} has no stage {options.stage}")
    images = open_images(options.scans, sensor=model.sensor)
    objective = model.objective(options.stage).train()
    noise = next(module for module in objective.modules() if isinstance(module, MaskNetwork)).noise
    noise.sums.zero_()
    rng = torch.Generator().manual_seed(0)
    for first in range(0, len(images), _AT_ONCE):
        some = images.batch(range(first, min(first + _AT_ONCE, len(images))))
        objective(Example(some), rng)
    _print_shares(noise)
    model.load_stage(options.stage, objective)
    folder = locate(options.run)
    options.out.mkdir(parents=True)
    for path in (folder / RUN_FILE, trained_on_file(folder)):
        if path is not None and path.is_file():
            shutil.copy(path, options.out)
    types = {weight.dtype for weight in read_tensors(folder / WEIGHTS_FILE)[0].values()}
    model.eval().save(options.out, 8 if torch.int8 in types else 16 if torch.float16 in types else 32)
    print(f"done: the run with these shares is in {options.out}")


def _print_shares(noise: PhaseNoise) -> None:
    print(f"{'lattice, pixel of its 2x2':28}{'down the columns':>18}{'along the rows':>18}")
    for phase, (down, along) in zip(noise.phases, noise.shares().tolist(), strict=True):
        print(f"{f'{phase.lattice.name}, ({phase.row}, {phase.column})':28}{down:18.3f}{along:18.3f}")


if __name__ == "__main__":
    main()
