"""Throughput of both stages: our loop beside a plain one with the released program's choices, in scans a second.

    OMP_NUM_THREADS=1 python benchmarks/training.py [--full] [--preset lidargrit_small] [--batch 2] [--steps 8]

Both loops train the same networks by the same losses on the same scans. The plain loop computes in 32 bits, writes
attention out as products over a square mask, asks a discriminator whose answer has the weight 0 (forward only), and
holds its batch in memory. Ours is what ``train`` runs: the preset's precision, reading prepared scans, augmentation,
the moving average and the log included; its checkpoints, validations and pictures are left out. Rounds of both take
turns and the best of each counts. On a CPU the time is the processor's, all threads together; on a GPU the clock's.
"""

import argparse
import copy
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import torch
from torch import nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from lidargrit.core import reporting
from lidargrit.core.reporting import Progress, Reporter
from lidargrit.data.images import RangeImages
from lidargrit.data.sources import load_range_images
from lidargrit.generation.generator import Generator
from lidargrit.generation.presets import load_preset
from lidargrit.generation.settings import Preset
from lidargrit.scans.example import Example
from lidargrit.training import training_flops
from lidargrit.training.stage import StageTraining

SCANS = 16
UNTIMED = 2  # steps: they allocate and choose kernels
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


def clock() -> float:
    if DEVICE.type == "cuda":
        torch.cuda.synchronize()
        return time.perf_counter()
    return time.process_time()


class StepClock(Reporter, Progress):
    """Notes when each step ended."""

    def __init__(self) -> None:
        self.times: list[float] = []

    @contextmanager
    def progress(self, what: str, total: int, done: int = 0) -> Iterator[Progress]:
        yield self

    def advance(self, amount: int, note: str = "") -> None:
        self.times.append(clock())


def discriminator() -> nn.Module:
    """Return the PatchGAN that the program asks and does not use: 64 channels, three layers, 2.76 M weights.

    Source:
        Isola et al., 2017; sizes of hamedhaghighi/LidarGRIT@a3f86e7.
    """
    layers: list[nn.Module] = [nn.Conv2d(1, 64, 4, 2, 1), nn.LeakyReLU(0.2)]
    for inputs, outputs, stride in ((64, 128, 2), (128, 256, 2), (256, 512, 1)):
        layers += [nn.Conv2d(inputs, outputs, 4, stride, 1, bias=False), nn.BatchNorm2d(outputs), nn.LeakyReLU(0.2)]
    return nn.Sequential(*layers, nn.Conv2d(512, 1, 4, 1, 1))


def plain(generator: Generator, stage: str, preset: Preset, images: RangeImages, steps: int) -> float:
    """Return the scans a second of the plain loop."""
    config = preset.training[stage]
    objective, critic = generator.objective(stage).to(DEVICE).train(), discriminator().to(DEVICE)
    optimiser = torch.optim.Adam(objective.parameters(), config.learning_rate, config.betas)
    batch = images.batch([index % len(images) for index in range(config.batch_size)]).to(DEVICE)
    begun = 0.0
    with sdpa_kernel(SDPBackend.MATH):
        for step in range(UNTIMED + steps):
            begun = clock() if step == UNTIMED else begun
            loss = objective(Example(batch), torch.Generator(DEVICE).manual_seed(step))["loss"]
            if stage == "tokenizer":
                with torch.no_grad():
                    critic(batch.range_m[:, None])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    return steps * config.batch_size / (clock() - begun)


def ours(generator: Generator, stage: str, preset: Preset, images: RangeImages, steps: int, folder: Path) -> float:
    """Return the scans a second of our loop."""
    config = preset.training[stage]
    scans = (UNTIMED + steps) * config.batch_size
    never = {"validate_every": 10**9, "checkpoint_every": 10**9, "validation_scans": 1}
    heard = StepClock()
    fit = StageTraining(generator.objective(stage), replace(config, scans=scans, **never), folder, 0).begun()
    with reporting.to(heard):
        fit.run(images, images, stage)
    return steps * config.batch_size / (heard.times[-1] - heard.times[UNTIMED - 1])


@contextmanager
def on_simulated_scans(preset: Preset) -> Iterator[tuple[RangeImages, Generator, dict[str, int], Path]]:
    """Yield a preset's scans, an untrained generator, the operations of its stages, and a folder removed at the end."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["LIDARGRIT_CACHE"] = folder
        images = load_range_images(preset.data.train, preset.data)
        torch.manual_seed(0)
        yield images, preset.build_generator(), training_flops(preset), Path(folder)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="the paper's KITTI-360 networks, two steps of one scan")
    parser.add_argument("--preset", default="lidargrit_small")
    parser.add_argument("--batch", type=int, default=0, help="scans (default: the preset's; 1 with --full)")
    parser.add_argument("--steps", type=int, default=0, help="timed (default: 8; 2 with --full)")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--set", nargs="+", default=[], help="settings of the preset")
    options = parser.parse_args()
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    steps = options.steps or (2 if options.full else 8)
    source = f"simulated:{SCANS}:train"
    settings = [f"data.train={source}", "data.workers=1", *options.set]
    preset = load_preset("lidargrit_kitti_360" if options.full else options.preset, settings)
    batch = options.batch or (1 if options.full else 0)
    if batch:
        preset = replace(preset, training={k: replace(v, batch_size=batch) for k, v in preset.training.items()})
    with on_simulated_scans(preset) as (images, generator, flops, folder):
        for stage in generator.stages:
            best = {"plain": 0.0, "ours": 0.0}
            for number in range(options.rounds):
                best["plain"] = max(best["plain"], plain(copy.deepcopy(generator), stage, preset, images, steps))
                run_folder = folder / f"{stage}{number}"
                best["ours"] = max(
                    best["ours"], ours(copy.deepcopy(generator), stage, preset, images, steps, run_folder)
                )
            a_scan, size = flops[stage] / preset.training[stage].scans, preset.training[stage].batch_size
            for name, rate in best.items():
                print(f"{stage}, batches of {size}, {name}: {rate:.3g} scans/s, {rate * a_scan / 1e9:.0f} GFLOP/s")
            print(f"{stage}: {best['ours'] / best['plain']:.2f} times")


if __name__ == "__main__":
    main()
