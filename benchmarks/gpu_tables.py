"""Two tables of a GPU in one run: sampling, then training, each beside its floor.

    python benchmarks/gpu_tables.py [--device cuda] [--seconds-each 12] [--small]

Sampling: scans a second, kernels of one batch, the share of the time in which a kernel runs, and memory. Networks that
take equal steps are timed with two numbers of steps, from which the published number follows. Training: scans a second
of each stage, plain and compiled, operations a second, memory, and waits of the host in 20 steps. A floor is the time
that operations at 798 TFLOP/s or bytes at 3.0 TB/s take on an H100, whichever is longer, if every operation reads and
writes its tensors in 16 bits; on another device no share is printed. ``--small`` takes the small presets, so that a CPU
shows that the script runs: ``--device cpu --small --seconds-each 1``. What fails is told, and the next begins.
"""

import argparse
import math
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from gpu_smoke import report
from sampling_gpu import recomputing

from lidargrit.api import load
from lidargrit.generation.batches import BatchSeeds
from lidargrit.generation.generator import Generator
from lidargrit.generation.presets import load_preset
from lidargrit.nn.transformer import CausalTransformer
from lidargrit.scans.condition import NOTHING
from lidargrit.scans.example import Example
from lidargrit.systems.lidargrit.system import LidarGrit
from lidargrit.training.compute import stage_costs, uniform_images
from lidargrit.training.stage import begin_training

_FEW, _MORE = 2, 6  # steps that are timed
_BATCHES = (1, 32, 128, 512)
_WAITS_OVER = 20  # steps


@dataclass(frozen=True)
class Sampled:
    """A run or a preset to sample, its published number of steps, and milliseconds a scan at the floor."""

    name: str
    steps: int = 0
    floor_ms: float = math.nan


SAMPLING = (
    Sampled("pretrained", floor_ms=0.36),
    Sampled("pretrained_wide", floor_ms=2.0),
    Sampled("lidargrit_kitti_360", floor_ms=2.6),
    Sampled("r2dm_kitti_360", 256, 276.0),
    Sampled("r2flow_kitti_360", 256, 782.0),
    Sampled("lidm_kitti_360", 50, 57.0),
)
SMALL_SAMPLING = (
    Sampled("pretrained"),
    Sampled("lidargrit_small"),
    Sampled("r2dm_small", 256, 10.0),
    Sampled("r2flow_small", 256, 26.0),
    Sampled("lidm_small", 50, 0.3),
)
# Presets, and for each stage the scans a second at the floor.
TRAINING = {
    "lidargrit_kitti_360": {"tokenizer": 683.0, "transformer": 2272.0},
    "lidargrit_wide_pixels": {"pixels": 2320.0},
    "r2dm_kitti_360": {"diffusion": 400.0},
}
SMALL_TRAINING = {"lidargrit_small": {"tokenizer": math.nan, "transformer": math.nan}}


def main() -> None:
    """Print both tables, each line when it is known."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--seconds-each", type=float, default=12.0)
    parser.add_argument("--small", action="store_true", help="small presets, and one scan at a time")
    options = parser.parse_args()
    device, seconds = torch.device(options.device), options.seconds_each
    is_gpu = device.type == "cuda"
    print(torch.cuda.get_device_name(device) if is_gpu else "a CPU, for a trial", torch.__version__, flush=True)
    for each in SMALL_SAMPLING if options.small else SAMPLING:
        for batch in _BATCHES[:1] if options.small else _BATCHES:
            report(f"sampling, {each.name}, batch {batch}", partial(sampling_line, each, batch, device, seconds))
    preset = load_preset("lidargrit_small" if options.small else "lidargrit_kitti_360")
    transformer = LidarGrit(preset.model, preset.data.load_sensor()).eval().to(device).transformer
    for batch in _BATCHES[: 1 if options.small else 2]:
        line = partial(recomputed_line, transformer, batch, device)
        report(f"sampling, tokens by recomputation, batch {batch}", line)
    for name, floors in (SMALL_TRAINING if options.small else TRAINING).items():
        for stage, floor in floors.items():
            for compiled in (False, True) if is_gpu else (False,):
                what = f"training, {name}, {stage}, {'compiled' if compiled else 'plain'}"
                report(what, partial(training_line, name, stage, compiled, floor, seconds))


def timed(work: Callable[[], object], device: torch.device, seconds: float) -> float:
    """Return the median of the seconds that some work takes, with everything on the device done, after one trial."""
    work()
    taken, begun = list[float](), time.perf_counter()
    while not taken or (time.perf_counter() - begun < seconds and len(taken) < 20):
        at = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        taken.append(time.perf_counter() - at)
    return sorted(taken)[len(taken) // 2]


def sampling_line(each: Sampled, batch: int, device: torch.device, seconds: float) -> str:
    """Return what sampling a batch takes."""
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)
    is_run = each.name.startswith("pretrained")
    generator: Generator = load(each.name) if is_run else load_preset(each.name).build_generator()
    generator.eval().to(device)

    @torch.no_grad()
    def sample(steps: int = 0) -> object:
        sampling = generator.parse_sampling([f"steps={steps}"] if steps else [])
        return generator._sample(BatchSeeds(range(batch), batch), NOTHING, sampling)

    if each.steps:
        few, more = (timed(partial(sample, steps), device, seconds / 2) for steps in (_FEW, _MORE))
        taken = few + (each.steps - _FEW) * max(more - few, 0.0) / (_MORE - _FEW)
    else:
        taken = timed(sample, device, seconds)
    line = f"{batch / taken:.3g} scans/s"
    if device.type != "cuda":
        return line
    kernels, busy = profiled(partial(sample, _MORE if each.steps else 0))
    gib = torch.cuda.max_memory_allocated(device) / 2**30
    note = f" of {_MORE} steps" if each.steps else ""
    share = each.floor_ms / 1000 * batch / taken
    return f"{line}, {share:.3f} of the floor, {kernels} kernels{note}, busy {busy:.0%}, {gib:.1f} GiB"


def profiled(work: Callable[[], object]) -> tuple[int, float]:
    """Return the kernels of some work on a GPU, and the share of its time in which one of them runs."""
    begun = time.perf_counter()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        begun = time.perf_counter()
        work()
        torch.cuda.synchronize()
        taken = time.perf_counter() - begun
    events = [each for each in profile.events() or () if each.device_type.name == "CUDA"]
    return len(events), sum(each.device_time for each in events) / 1e6 / taken


@torch.no_grad()
def recomputed_line(transformer: CausalTransformer, batch: int, device: torch.device) -> str:
    """Return how fast the tokens of scans come by reading the whole prefix anew for every token."""
    return f"{batch / recomputing(transformer, batch, device):.3g} scans/s"


def training_line(name: str, stage: str, compiled: bool, floor: float, seconds: float) -> str:
    """Return what a step of a stage takes, and how often the host waits for the device."""
    preset = load_preset(name)
    config = replace(preset.settings_of(stage), compile=compiled, precision="auto")
    flops = stage_costs(preset)[stage].flops_per_scan
    objective = preset.build_generator().objective(stage)
    engine, _ = begin_training(objective, config)
    images, seed = uniform_images(preset.data.load_sensor(), config.batch_size), iter(range(10**6))
    example = Example(images).with_keys().to(engine.device)

    def step() -> None:
        engine.step(example, next(seed), config.gradient_clip)

    taken = timed(step, engine.device, seconds)
    per_s = config.batch_size / taken
    rates = f"{per_s:.3g} scans/s, {per_s * flops / 1e12:.3g} TFLOP/s"
    line = f"batch {config.batch_size}, {rates}, {engine.peak_gib():.1f} GiB"
    if engine.device.type != "cuda":
        return line
    return f"{line}, {per_s / floor:.3f} of the floor, {waits(step)} waits in {_WAITS_OVER} steps"


def waits(step: Callable[[], None]) -> int:
    """Return how often the host waits for a GPU, as torch itself tells, in some steps."""
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            for _ in range(_WAITS_OVER):
                step()
        return len(told)
    finally:
        torch.cuda.set_sync_debug_mode("default")


if __name__ == "__main__":
    main()
