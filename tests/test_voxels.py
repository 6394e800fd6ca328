"""Voxels of range images, and range images of voxels, against slow loops and by their properties."""

import math

import pytest
import torch

from lidargrit.core.errors import ConfigError
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.systems.ultralidar.voxels import VoxelGrid, images_of_voxels, points_of_voxels, voxels_of_images

SENSOR = load_sensor("hdl64e_kitti_360").with_columns(24)
GRID = VoxelGrid((-12.0, -9.0, -3.0), (0.75, 0.5, 0.5), (32, 32, 10))


def images(count=2):
    rng = torch.Generator().manual_seed(0)
    range_m = 1.5 + 14 * torch.rand(count, 64, 24, generator=rng)
    return RangeImage.masked(range_m, torch.rand(count, 64, 24, generator=rng) < 0.7, SENSOR)


def in_box(batch):
    points = batch.range_m[..., None] * SENSOR.ray_directions()
    low, side = torch.tensor(GRID.low_m), torch.tensor(GRID.cell_m)
    return batch.return_mask & ((points >= low) & (points < low + side * torch.tensor(GRID.cells))).all(dim=-1)


def test_voxels_hold_the_points_and_no_others():
    batch = images()
    found = voxels_of_images(batch, GRID)
    wanted = torch.zeros_like(found)
    for scan, image in enumerate(batch.range_m):
        for point in (image[..., None] * SENSOR.ray_directions())[image > 0].tolist():
            x, y, z = (
                math.floor((of - low) / side) for of, low, side in zip(point, GRID.low_m, GRID.cell_m, strict=True)
            )
            if 0 <= x < 32 and 0 <= y < 32 and 0 <= z < 10:
                wanted[scan, z, y, x] = True
    assert torch.equal(found, wanted)
    assert 100 < int(found.sum()) < 3000


def test_points_are_centres_or_what_the_program_writes():
    occupied = torch.zeros(GRID.shape, dtype=torch.bool)
    occupied[2, 3, 5] = True
    assert points_of_voxels(occupied, GRID).tolist() == [[-12 + 5.5 * 0.75, -9 + 3.5 * 0.5, -3 + 2.5 * 0.5]]
    assert points_of_voxels(occupied, GRID, "reference").tolist() == [[-9 + 3 * 0.5, -12 + 5 * 0.75, -3 + 2 * 0.5]]


def test_every_return_in_the_box_stays_one_and_none_moves_away_by_more_than_half_a_cell():
    batch = images()
    back = images_of_voxels(voxels_of_images(batch, GRID), GRID, SENSOR)
    inside = in_box(batch)
    assert bool(back.return_mask[inside].all())
    assert float((back.range_m - batch.range_m)[inside].max()) <= math.hypot(*GRID.cell_m) / 2
    alone = RangeImage.masked(batch.range_m[:1], torch.zeros(1, 64, 24, dtype=torch.bool), SENSOR)
    assert not bool(images_of_voxels(voxels_of_images(alone, GRID), GRID, SENSOR).return_mask.any())


def test_a_ray_ends_at_the_first_occupied_voxel_that_it_meets():
    rng = torch.Generator().manual_seed(1)
    occupied = torch.rand(1, *GRID.shape, generator=rng) < 0.02
    sensor = SENSOR.with_columns(8)
    found = images_of_voxels(occupied, GRID, sensor).range_m[0].double()
    low, side = (torch.tensor(of, dtype=torch.float64) for of in (GRID.low_m, GRID.cell_m))
    rays = sensor.ray_directions().double()
    wanted, done = torch.zeros(64, 8, dtype=torch.float64), torch.zeros(64, 8, dtype=torch.bool)
    for step in range(round(sensor.range_min_m / 0.01), 1600):  # along all rays, 1 cm at a time
        cell = ((rays * (0.01 * step) - low) / side).floor()
        inside = ((cell >= 0) & (cell < torch.tensor(GRID.cells))).all(dim=-1)
        x, y, z = torch.where(inside[..., None], cell, 0).long().unbind(dim=-1)
        along_m = (((cell + 0.5) * side + low) * rays).sum(dim=-1)
        here = inside & occupied[0, z, y, x] & ~done
        along_m = along_m.clamp(min=sensor.range_min_m)
        wanted[here], done = along_m[here], done | here
    differing = (found - wanted).abs() > 1e-4
    assert 0.3 < float(done.float().mean()) < 1
    assert int(differing.sum()) <= 0.03 * differing.numel()  # corners that a ray crosses for less than 1 cm
    assert bool((found[differing] > 0).all())


def test_the_reference_variant_is_the_picture_of_swapped_clouds():
    occupied = voxels_of_images(images(), GRID)
    swapped = images_of_voxels(occupied.transpose(-1, -2), GRID.swapped(), SENSOR)
    found = images_of_voxels(occupied, GRID, SENSOR, "reference")
    assert not torch.equal(found.range_m, images_of_voxels(occupied, GRID, SENSOR).range_m)
    both = found.return_mask & swapped.return_mask  # others met a voxel whose corner is nearer than the sensor's limit
    assert float(both.float().mean()) > 0.8 * float(swapped.return_mask.float().mean())
    assert float((found.range_m - swapped.range_m)[both].abs().median()) <= math.hypot(*GRID.cell_m) / 2


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"low_m": (1.0, -50.0, -3.73)}, "a box from"),
        ({"cells": (640, 640, 4)}, "a box from"),
        ({"cell_m": (0.0, 1.0, 1.0)}, "cell_m="),
        ({"cell_m": (math.nan, 1.0, 1.0)}, "cell_m="),
        ({"cells": (0, 640, 40)}, "cells="),
        ({"cells": (64000, 64000, 40)}, "cells="),
    ],
)
def test_boxes_that_cannot_be_are_refused(settings, message):
    with pytest.raises(ConfigError, match=f"^got .*{message}"):
        VoxelGrid(**settings)
