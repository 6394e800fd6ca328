"""Simulated scans per second on one and more processes, and the memory over many of them.

    python benchmarks/simulator.py [--sensor hdl64e_kitti_360] [-n 200] [--processes 1 2] [--repeats 3]

The scene is sampled anew for every scan, as training needs it. The best of several repeats counts, because other work
on the machine only slows things down. With -n 10000 the memory of a process shows whether anything is left behind.
"""

import argparse
import multiprocessing
import time
from pathlib import Path

from lidargrit.scans.sensors import load_sensor
from lidargrit.simulator import simulate


def resident_mb() -> float:
    """Return the memory that this process holds (Linux)."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * 4096 / 1e6


def work(name: str, seeds: range) -> tuple[int, list[float]]:
    """Simulate some scans; return how many points they have and the memory, held ten times on the way."""
    sensor, points, memory = load_sensor(name), 0, []
    for count, seed in enumerate(seeds):
        points += len(simulate(seed, sensor))
        if count % max(1, len(seeds) // 10) == 0:
            memory.append(resident_mb())
    return points, [*memory, resident_mb()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensor", default="hdl64e_kitti_360")
    parser.add_argument("-n", type=int, default=200, help="scans for each process")
    parser.add_argument("--processes", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    sensor = load_sensor(options.sensor).fine()
    print(f"{options.sensor}, {sensor.height}x{sensor.width}, scene included, {options.n} scans a process")
    for processes in options.processes:
        best, memory = 0.0, []
        with multiprocessing.get_context("spawn").Pool(processes) as pool:
            pool.starmap(work, [(options.sensor, range(2))] * processes)  # imports and first allocations do not count
            for _ in range(options.repeats):
                shares = [(options.sensor, range(p * options.n, (p + 1) * options.n)) for p in range(processes)]
                begun = time.perf_counter()
                done = pool.starmap(work, shares)
                best = max(best, processes * options.n / (time.perf_counter() - begun))
                memory = done[0][1]
        held = " ".join(f"{megabytes:.0f}" for megabytes in memory)
        print(f"{processes} processes: {best:.1f} scans/s; memory of one on the way, MB: {held}")


if __name__ == "__main__":
    main()
