"""What every system costs at its small and at its published size → a Markdown table.

    OMP_NUM_THREADS=1 python benchmarks/systems.py [lidm r2flow ...] [--json systems.json]

Parameters are those of the networks that sample. Operations are counted: of one scan in training, all stages together,
forward and backward, and of one sampled scan, by the defaults of the system. At the small size both are also timed: a
training step as `train --measure` does, by the clock, and one scan, seed to range image, in processor seconds, by
networks that are not trained. The published sizes are not timed: some take minutes a scan on a processor.
"""

import argparse
import time
from pathlib import Path

import torch

from lidargrit.core.files import write_json
from lidargrit.generation.presets import load_preset
from lidargrit.generation.settings import Preset
from lidargrit.training import measure, training_flops

PAIRS = {  # system → its small preset, and that of the published size
    "lidargrit": ("lidargrit_small", "lidargrit_kitti_360"),
    "lidargan": ("lidargan_small", "lidargan_kitti_odometry"),
    "lidarvae": ("lidarvae_small", "lidarvae_kitti_odometry"),
    "dusty": ("dusty_small", "dusty_kitti_odometry"),
    "lidargen": ("lidargen_small", "lidargen_kitti_360"),
    "ultralidar": ("ultralidar_small", "ultralidar_kitti_360"),
    "r2dm": ("r2dm_small", "r2dm_kitti_360"),
    "r2flow": ("r2flow_small", "r2flow_kitti_360"),
    "lidm": ("lidm_small", "lidm_kitti_360"),
    "lidm_shared": ("lidm_small_shared", "lidm_kitti_360_shared"),
}


def counted(preset: Preset) -> dict[str, float]:
    """Return parameters, operations of a training scan and of a sampled one."""
    flops, generator = training_flops(preset), preset.build_generator()
    parameters = sum(weight.numel() for weight in generator.parameters())
    a_scan = sum(flops[stage] / preset.training[stage].scans for stage in flops)
    return {"parameters": parameters, "training": a_scan, "sampling": generator.cost().flops}


def seconds_a_step(preset: Preset) -> dict[str, float]:
    """Return the time of a training step, by stage and number of scans."""
    sizes = {stage: config.batch_size for stage, config in preset.training.items()}
    return {f"{each.stage} ({sizes[each.stage]})": sizes[each.stage] / each.scans_per_s for each in measure(preset)}


def seconds_a_scan(preset: Preset) -> float:
    """Return the processor time of sampling one scan by the defaults."""
    torch.manual_seed(0)
    generator = preset.build_generator().eval()
    begun = time.process_time()
    generator.sample([0])
    return time.process_time() - begun


def main() -> None:
    """Measure every system and print its line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("systems", nargs="*", help="default: all")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows = {}
    heads = (
        "parameters",
        "operations a training scan",
        "seconds a step (scans)",
        "operations a scan",
        "seconds a scan",
    )
    print(f"| system | size | {' | '.join(heads)} |\n|---|---|{'---|' * len(heads)}")
    for name in options.systems or PAIRS:
        for size, preset in zip(("small", "published"), map(load_preset, PAIRS[name]), strict=True):
            row = counted(preset)
            steps = seconds_a_step(preset) if size == "small" else {}
            scan_s = seconds_a_scan(preset) if size == "small" else None
            rows[f"{name} {size}"] = {**row, "seconds_a_step": steps, "seconds_a_scan": scan_s}
            told = ", ".join(f"{stage} {seconds:.2g}" for stage, seconds in steps.items())
            cells = f"{row['parameters']:,.0f} | {row['training']:.1e} | {told} | {row['sampling']:.1e}"
            print(f"| {name} | {size} | {cells} | {'' if scan_s is None else f'{scan_s:.2g}'} |", flush=True)
    if options.json:
        write_json(options.json, rows)


if __name__ == "__main__":
    main()
