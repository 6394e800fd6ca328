"""Labelled streets, their objects found by a slow search, and the known damages of benchmarks/damages.py."""

import functools
import sys
from collections import deque
from pathlib import Path

import numpy as np

from lidargrit.scans.classes import CLASSES
from lidargrit.scans.projection import project
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.simulator import simulate

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from damages import blurred, boxes_for_vehicles, without_vehicles  # noqa: F401 — for the tests of metrics

SENSOR = load_sensor("hdl64e_kitti_odometry")
KINDS = {10: 0, 18: 0, 20: 0, 30: 1, 31: 1, 32: 1, 80: 2, 71: 3}  # by the benchmark's number


@functools.cache
def street(seed: int) -> RangeImage:
    """Simulate one labelled street."""
    return project(simulate(seed=seed, sensor=SENSOR), SENSOR)


def streets(first: int, count: int) -> RangeImage:
    """Simulate labelled streets of consecutive seeds."""
    return RangeImage.stack([street(first + number) for number in range(count)])


def kind_of(label: int) -> int:
    """Return 0 to 3 for a label of a vehicle, a person, a pole or a trunk, -1 for all others."""
    return KINDS.get(CLASSES[label].learned if label in CLASSES else 0, -1)


def searched_objects(image: RangeImage) -> list[list[tuple[int, int]]]:
    """Return the pixels of each object of an image, by a breadth-first search from pixel to pixel."""
    label, range_m = image.label.tolist(), image.range_m.tolist()
    height, width = image.range_m.shape
    kinds = [[kind_of(label[r][c]) if range_m[r][c] > 0 else -1 for c in range(width)] for r in range(height)]
    seen, found = set(), []
    for start in np.ndindex(height, width):
        if kinds[start[0]][start[1]] < 0 or start in seen:
            continue
        seen.add(start)
        pixels, waiting = [], deque([start])
        while waiting:
            row, column = waiting.popleft()
            pixels.append((row, column))
            for down in range(-2, 3):
                for right in range(-2, 3):
                    r, c = row + down, (column + right) % width
                    if not 0 <= r < height or (r, c) in seen or kinds[r][c] != kinds[row][column]:
                        continue
                    if abs(np.float32(range_m[r][c]) - np.float32(range_m[row][column])) <= 1:
                        seen.add((r, c))
                        waiting.append((r, c))
        if len(pixels) >= 6:
            found.append(pixels)
    return found
