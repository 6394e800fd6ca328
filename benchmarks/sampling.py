"""Scans per minute with the key/value cache against recomputation, side by side in one run.

    python benchmarks/sampling.py [--recipe lidargrit_kitti_odometry] [--batch 1 4]

Random weights: the time does not depend on them. Recomputation reads the whole prefix for every token, as the released
program does; it is timed at several lengths of the prefix and summed over all, for a whole scan would take minutes.
"""

import argparse
import time

import torch

from lidargrit.generators.lidargrit import LidarGrit, TokenSampling, sample_tokens
from lidargrit.recipes import load_recipe


def seconds(work) -> float:
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recipe", default="lidargrit_kitti_odometry")
    parser.add_argument("--batch", type=int, nargs="+", default=[1, 4])
    options = parser.parse_args()
    recipe = load_recipe(options.recipe)
    generator = LidarGrit(recipe.model, recipe.data.load_sensor()).eval()
    transformer, length = generator.transformer, generator.transformer.context_length
    print(f"{options.recipe}: {length} tokens a scan, {torch.get_num_threads()} threads")
    print(f"{'batch':>5}{'cached s':>12}{'recomputed s':>14}{'ratio':>8}{'scans/min cached':>18}{'whole scan':>12}")
    with torch.no_grad():
        for batch in options.batch:
            uniform = torch.rand((batch, length))
            cached = seconds(lambda uniform=uniform: sample_tokens(transformer, uniform, TokenSampling()))
            prefixes = [torch.zeros((batch, n), dtype=torch.long) for n in range(length // 16, length + 1, length // 8)]
            steps = [min(seconds(lambda p=p: transformer(p)) for _ in range(2)) for p in prefixes]
            recomputed = sum(steps) / len(steps) * length  # midpoints of eight equal spans of the length
            whole = seconds(lambda batch=batch: generator.sample(range(batch)))
            print(
                f"{batch:>5}{cached:>12.2f}{recomputed:>14.2f}{recomputed / cached:>8.1f}{60 * batch / cached:>18.1f}"
                f"{60 * batch / whole:>8.1f}/min"
            )


if __name__ == "__main__":
    main()
