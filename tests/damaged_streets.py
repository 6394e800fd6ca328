"""Labelled streets with known damages, and their objects found by a slow search."""

import functools
from collections import deque
from dataclasses import replace

import numpy as np
import torch

from lidargrit.scans.classes import CLASSES
from lidargrit.scans.projection import points_of_pixels, project
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.simulator import simulate

SENSOR = load_sensor("hdl64e_kitti_odometry")
KINDS = {10: 0, 18: 0, 20: 0, 30: 1, 31: 1, 32: 1, 80: 2, 71: 3}  # by the benchmark's number


@functools.cache
def streets(first: int, count: int) -> RangeImage:
    """Simulate labelled streets."""
    return RangeImage.stack([project(simulate(seed=first + seed, sensor=SENSOR), SENSOR) for seed in range(count)])


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


def blurred(images: RangeImage, columns: int) -> RangeImage:
    """Give each return the mean range of the returns among neighbouring columns."""
    shifts = range(-(columns // 2), columns // 2 + 1)
    total = sum(images.range_m.roll(shift, -1) for shift in shifts)
    count = sum(images.return_mask.roll(shift, -1).float() for shift in shifts)
    return replace(images, range_m=torch.where(images.return_mask, total / count.clamp(min=1), 0))


def without_vehicles(images: RangeImage, share: float = 1.0) -> RangeImage:
    """Drop the returns of vehicles, or of a share of them."""
    gone = torch.zeros_like(images.return_mask)
    number = 0
    for index in range(len(images)):
        for pixels in searched_objects(images[index]):
            if kind_of(int(images.label[index][pixels[0]])) == 0:
                number += 1
                if number * share % 1 < share:
                    for pixel in pixels:
                        gone[index][pixel] = True
    return RangeImage.masked(images.range_m, images.return_mask & ~gone, images.sensor, images.planes)


def boxes_for_vehicles(images: RangeImage) -> RangeImage:
    """Put an upright box of the same length, width and height in the place of each vehicle."""
    ones = torch.ones_like(images.return_mask[0])
    rays = points_of_pixels(RangeImage(ones.float(), ones, images.sensor)).double().numpy()
    made = []
    for image in images:
        range_m, label, gone = image.range_m.clone(), image.label.clone(), torch.zeros_like(ones)
        points = points_of_pixels(image).double().numpy()
        for pixels in searched_objects(image):
            if kind_of(int(image.label[pixels[0]])) != 0:
                continue
            at = tuple(np.array(pixels).T)
            entry_m = torch.from_numpy(_entry_into_box(rays, points[at]))
            gone[at] = True
            hit = entry_m.isfinite() & (gone | (entry_m < range_m) | ~image.return_mask)
            range_m = torch.where(hit, entry_m.float(), range_m)
            label = torch.where(hit, 10, label)
            gone &= ~hit
        mask = ((image.return_mask & ~gone) | (label == 10)) & (range_m > 0)
        made.append(RangeImage.masked(range_m, mask, images.sensor, {"label": label}))
    return RangeImage.stack(made)


def _entry_into_box(rays: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return at which distance each ray from the origin enters the box around points, infinite where it does not."""
    centre = points[:, :2].mean(0)
    _, axes = np.linalg.eigh(np.cov((points[:, :2] - centre).T))
    turn = np.eye(3)
    turn[:2, :2] = axes
    low, high = (points @ turn).min(0), (points @ turn).max(0)
    with np.errstate(divide="ignore"):
        crossings = np.stack((low / (rays @ turn), high / (rays @ turn)))
    enter, leave = crossings.min(0).max(-1), crossings.max(0).min(-1)
    return np.where((enter < leave) & (enter > 0), enter, np.inf)
