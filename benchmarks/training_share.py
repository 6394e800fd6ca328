"""Share of a training step that its matrix products and convolutions would take if they ran alone.

    OMP_NUM_THREADS=1 python benchmarks/training_share.py [--preset lidargrit_small] [--steps 8] [--set NAME=VALUE ...]

For each stage, steps of ``train`` are listed call by call: the products and convolutions of its forward and backward
passes, of the frozen tokenizer that encodes the scans, and of the optimiser, each with its shapes, strides and number
type. Each distinct call is then repeated by itself on random numbers of these shapes, and its best time counts as often
as the call occurs in a step. Their sum is what the step would take if everything else (attention, normalisation, sums,
reading, augmentation, moving averages and the log) took no time. Times are those of the processor, from one run.
"""

import argparse
import copy
import os
import time
from collections import Counter, defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from training import SCANS, on_simulated_scans, ours

from lidargrit.data.images import RangeImages
from lidargrit.generation.generator import Generator
from lidargrit.generation.presets import load_preset
from lidargrit.generation.settings import Preset

ATEN = torch.ops.aten
COUNTED = {ATEN.mm, ATEN.addmm, ATEN.bmm, ATEN.baddbmm, ATEN.convolution, ATEN.convolution_backward}
REPEATS, ROUNDS = 3, 4
LISTED = 4  # steps

Call = tuple[Any, ...]  # an operator and its arguments, with shape, strides and type in the place of each tensor


class Calls(TorchDispatchMode):
    """Counts the products and convolutions that run inside, by operator and shapes."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[Call] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None) -> Any:
        if func.overloadpacket in COUNTED:
            self.counts[(func, *(_described(argument) for argument in args))] += 1
        return func(*args, **(kwargs or {}))


def _described(argument: Any) -> Any:
    if isinstance(argument, Tensor):
        return tuple(argument.shape), tuple(argument.stride()), argument.dtype
    return ("list", *argument) if isinstance(argument, list) else argument


def _made(described: Any) -> Any:
    if not isinstance(described, tuple):
        return described
    if described[:1] == ("list",):
        return list(described[1:])
    shape, stride, dtype = described
    return torch.empty_strided(shape, stride, dtype=dtype).normal_()


def number_type(call: Call) -> str:
    """Return the number type of a call's first tensor."""
    first = next(part for part in call[1:] if isinstance(part, tuple) and part[:1] != ("list",))
    return str(first[2]).removeprefix("torch.")


def seconds_alone(call: Call) -> float:
    """Return the best processor time of a call by itself."""
    operator, *described = call
    arguments, best = [_made(part) for part in described], float("inf")
    for _ in range(ROUNDS):
        begun = time.process_time()
        for _ in range(REPEATS):
            operator(*arguments)
        best = min(best, (time.process_time() - begun) / REPEATS)
    return best


def calls_of_steps(
    generator: Generator, stage: str, preset: Preset, images: RangeImages, folder: Path
) -> dict[Call, float]:
    """Return how often each call occurs in a step, on average.

    A short training is taken off a longer one, so that what happens once, such as the validation at the end, is left
    out.
    """
    counts: list[Counter[Call]] = []
    for steps in (1, 1 + LISTED):
        with Calls() as calls:
            ours(copy.deepcopy(generator), stage, preset, images, steps, folder / str(steps))
        counts.append(calls.counts)
    short, long = counts
    return {call: (count - short[call]) / LISTED for call, count in long.items()}


def by_kind(counts: Mapping[Call, float]) -> dict[str, float]:
    """Return the seconds of a step's products and convolutions alone, by operator and number type."""
    seconds: dict[str, float] = defaultdict(float)
    for call, count in counts.items():
        seconds[f"{call[0].overloadpacket.__name__}, {number_type(call)}"] += count * seconds_alone(call)
    return dict(sorted(seconds.items(), key=lambda entry: -entry[1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="lidargrit_compact_pixels")
    parser.add_argument("--steps", type=int, default=8, help="timed (default: 8)")
    parser.add_argument("--set", nargs="+", default=[], help="settings of the preset")
    options = parser.parse_args()
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    preset = load_preset(options.preset, [f"data.train=simulated:{SCANS}:train", "data.workers=1", *options.set])
    with on_simulated_scans(preset) as (images, generator, flops, folder):
        for stage in generator.stages:
            fit = preset.training[stage]
            rate = ours(copy.deepcopy(generator), stage, preset, images, options.steps, folder / stage)
            counts = calls_of_steps(generator, stage, preset, images, folder / f"{stage}_listed")
            kinds, step = by_kind(counts), fit.batch_size / rate
            speed = rate * flops[stage] / fit.scans / 1e9
            print(f"{stage}, batches of {fit.batch_size}: {step:.3f} s a step, {speed:.0f} GFLOP/s")
            print(f"  products and convolutions alone: {sum(kinds.values()):.3f} s, {sum(kinds.values()) / step:.0%}")
            for kind, seconds in kinds.items():
                print(f"    {seconds:.4f} s  {kind}")


if __name__ == "__main__":
    main()
