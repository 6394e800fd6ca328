"""Milliseconds to project one scan: ours, a plain NumPy version that sorts, and a Python loop, side by side in one run.

    python benchmarks/projection.py [--scans SOURCE] [--count 4] [--repeats 30]

One thread. Every version gives the same image, which is checked. Times are the best of the repeats, for other work on
the machine only ever adds to them. The tests compare ours with the two versions here.
"""

import argparse
import math
import time
from dataclasses import replace

import numpy as np
import torch

from lidargrit.data.datasets import open_dataset
from lidargrit.scans.planes import planes_of
from lidargrit.scans.projection import index_map, project
from lidargrit.scans.sensors import SensorModel, load_sensor
from lidargrit.scans.types import RangeImage, Scan


def row_edges(sensor: SensorModel) -> np.ndarray:
    """Return the elevations midway between rows, and as far beyond the outermost rows; falling."""
    middle = sensor.elevation_rad.mean(dim=1).double().numpy()
    inner = (middle[1:] + middle[:-1]) / 2
    return np.concatenate(([2 * middle[0] - inner[0]], inner, [2 * middle[-1] - inner[-1]]))


def by_sorting(scan: Scan, sensor: SensorModel, method: str) -> np.ndarray:
    """Return which point fills each fine pixel: all in double precision, then written from far to near."""
    xyz_m = scan.points_xyz_m.numpy()
    height, width = sensor.height, sensor.width * sensor.column_stride
    wide = xyz_m.astype(np.float64)
    azimuth = np.arctan2(wide[:, 1], wide[:, 0])
    column = np.floor((np.pi - azimuth) * (width / (2 * np.pi))).astype(np.int64) % width
    if method == "spherical":
        elevation = np.arctan2(wide[:, 2], np.hypot(wide[:, 0], wide[:, 1]))
        row = np.searchsorted(-row_edges(sensor), -elevation, side="right") - 1
    elif scan.ring is not None:
        row = scan.ring.numpy().astype(np.int64)
    else:
        starts = np.flatnonzero(np.diff(azimuth % (2 * np.pi)) < -np.pi) + 1
        lengths = np.diff(np.concatenate(([0], starts, [len(xyz_m)])))
        true_ring = lengths >= max(1.0, 0.01 * float(np.median(lengths)))
        row = np.repeat(np.maximum(np.cumsum(true_ring) - 1, 0), lengths)
    range_m = np.linalg.norm(xyz_m, axis=1)
    eligible = (row >= 0) & (row < height) & (range_m >= sensor.range_min_m) & (range_m <= sensor.range_max_m)
    far_to_near = np.argsort(-range_m, kind="stable")
    far_to_near = far_to_near[eligible[far_to_near]]
    winner = np.full((height, width), -1, dtype=np.int32)
    winner[row[far_to_near], column[far_to_near]] = far_to_near
    return winner


def by_loop(scan: Scan, sensor: SensorModel, method: str) -> np.ndarray:
    """Return the same, point by point."""
    height, width = sensor.height, sensor.width * sensor.column_stride
    rings = None if scan.ring is None else scan.ring.tolist()
    edges = row_edges(sensor).tolist()
    winner = np.full((height, width), -1, dtype=np.int32)
    nearest = [[math.inf] * width for _ in range(height)]
    ring, before = 0, 0.0
    ranges = np.linalg.norm(scan.points_xyz_m.numpy(), axis=1).tolist()
    for index, ((x, y, z), range_m) in enumerate(zip(scan.points_xyz_m.tolist(), ranges, strict=True)):
        azimuth = math.atan2(y, x)
        column = math.floor((math.pi - azimuth) * (width / (2 * math.pi))) % width
        turned = azimuth % (2 * math.pi)
        ring, before = ring + (turned - before < -math.pi), turned
        if method == "unfolding":
            row = ring if rings is None else rings[index]
        else:
            elevation = math.atan2(z, math.hypot(x, y))
            row = next((row for row, edge in enumerate(edges[1:]) if elevation > edge), height)
            row = -1 if elevation > edges[0] else row
        inside = 0 <= row < height and sensor.range_min_m <= range_m <= sensor.range_max_m
        if inside and range_m <= nearest[row][column]:
            nearest[row][column], winner[row, column] = range_m, index
    return winner


def image_of(winner: np.ndarray, scan: Scan, sensor: SensorModel) -> RangeImage:
    """Return the range image of the winners, as every version must in the end."""
    winner, filled = winner[:, :: sensor.column_stride], winner[:, :: sensor.column_stride] >= 0
    range_m = np.where(filled, np.linalg.norm(scan.points_xyz_m.numpy(), axis=1)[winner], np.float32(0))
    reflectance = None
    if scan.reflectance is not None:
        reflectance = torch.from_numpy(np.where(filled, scan.reflectance.numpy()[winner], np.float32(0)))
    return RangeImage(torch.from_numpy(range_m), torch.from_numpy(filled), sensor, planes_of(reflectance=reflectance))


def best_ms(work, repeats: int) -> float:
    """Return the least of several times."""
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        work()
        times.append(time.perf_counter() - begun)
    return 1000 * min(times)


def main() -> None:
    """Time all versions on all scans."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", default="simulated:100", help="a source of scans of an HDL-64E, in firing order")
    parser.add_argument("--count", type=int, default=4, help="scans, evenly spaced")
    parser.add_argument("--repeats", type=int, default=30)
    options = parser.parse_args()
    torch.set_num_threads(1)
    dataset = open_dataset(options.scans)
    step = max(len(dataset) // options.count, 1)
    scans = [dataset.scan(index) for index in range(0, len(dataset), step)][: options.count]
    scans = [replace(scan, ring=None) for scan in scans]  # rings are found, as in a file of KITTI
    print(
        f"{sum(map(len, scans)) / len(scans):.0f} points a scan, ms a scan, best of {options.repeats}, mean over scans"
    )
    print(f"{'':<46}{'ours':>8}{'sorting':>9}{'loop':>9}")
    for name, method in (("hdl64e_kitti_360", "spherical"), ("hdl64e_kitti_odometry", "unfolding")):
        sensor = load_sensor(name).fine()
        times = []
        for scan in scans:
            versions = [by_sorting(scan, sensor, method), by_loop(scan, sensor, method)]
            same = [np.array_equal(index_map(scan, sensor, method), version) for version in versions]
            assert all(same), f"{scan.source}: sorting, loop give the same image: {same}"
            times.append(
                (
                    best_ms(lambda: project(scan, sensor, method), options.repeats),  # noqa: B023  called at once
                    best_ms(lambda: image_of(by_sorting(scan, sensor, method), scan, sensor), options.repeats),  # noqa: B023
                    best_ms(lambda: image_of(by_loop(scan, sensor, method), scan, sensor), 1),  # noqa: B023
                )
            )
        ours, sorting, loop = np.mean(times, axis=0)
        print(f"{f'{method} to {sensor.height}x{sensor.width}, {name}':<46}{ours:>8.2f}{sorting:>9.2f}{loop:>9.1f}")


if __name__ == "__main__":
    main()
