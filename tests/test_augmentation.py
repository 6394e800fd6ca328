"""Augmentations: range and mask change together, and what comes in from outside is no return."""

import pytest
import torch

from lidargrit.scans.augmentation import augment
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage

SENSOR = load_sensor("hdl64e_kitti_odometry")


def images_of(count, share=0.8):
    rng = torch.Generator().manual_seed(0)
    size = (count, SENSOR.height, SENSOR.width)
    return RangeImage.masked(torch.rand(size, generator=rng) * 50 + 1, torch.rand(size, generator=rng) < share, SENSOR)


@pytest.mark.parametrize("kind", ["flip", "roll", "geometric", "geometric_reference"])
def test_the_seed_decides_and_images_stay_valid(kind):
    images = images_of(8)
    first, again, other = (
        augment(Example(images), (kind,), torch.Generator().manual_seed(seed)).images for seed in (1, 1, 2)
    )
    assert torch.equal(first.range_m, again.range_m)  # that they are valid was checked when they were made
    assert not torch.equal(first.range_m, other.range_m)
    assert torch.equal(first.return_mask, first.range_m > 0)


def test_flip_mirrors_half_of_the_images():
    images = images_of(400)
    flipped = augment(Example(images), ("flip",), torch.Generator().manual_seed(0)).images.range_m
    same = (flipped == images.range_m).flatten(1).all(1)
    mirrored = (flipped == images.range_m.flip(-1)).flatten(1).all(1)
    assert bool((same | mirrored).all())
    assert 150 < int(mirrored.sum()) < 250


def test_roll_turns_each_image_by_whole_columns():
    images = images_of(6)
    rolled = augment(Example(images), ("roll",), torch.Generator().manual_seed(0)).images.range_m
    for before, after in zip(images.range_m, rolled, strict=True):
        assert any(torch.equal(before.roll(-shift, -1), after) for shift in range(SENSOR.width))


def test_geometric_fills_with_no_return_and_the_programs_with_a_far_wall():
    full = RangeImage(torch.full((64, 64, 256), 9.0), torch.ones(64, 64, 256, dtype=torch.bool), SENSOR)
    ours = augment(Example(full), ("geometric",), torch.Generator().manual_seed(0)).images
    assert set(ours.range_m.unique().tolist()) == {0.0, 9.0}
    assert 0.02 < float((~ours.return_mask).float().mean()) < 0.4
    program = augment(Example(full), ("geometric_reference",), torch.Generator().manual_seed(0)).images
    assert set(program.range_m.unique().tolist()) == {9.0, SENSOR.range_max_m}
    assert bool(program.return_mask.all())
    untouched = (ours.range_m == 9).flatten(1).all(1)
    assert 16 < int(untouched.sum()) < 48  # probability one half


def test_a_rotation_keeps_shapes_in_pixels():
    """A square stays a square of about the same size, though the image is four times as wide as high."""
    square = torch.zeros(200, 64, 256)
    square[:, 24:40, 120:136] = 7.0
    images = RangeImage(square, square > 0, SENSOR)
    turned = augment(Example(images), ("geometric",), torch.Generator().manual_seed(0)).images.return_mask
    area = turned.sum((1, 2)) / 256
    assert float(area.min()) > 0.7
    assert float(area.max()) < 1.3
    rows, columns = turned.any(2).sum(1), turned.any(1).sum(1)
    assert float((rows / columns).max()) < 1.25  # a squeezed map would make it up to four times longer one way
    assert float((rows / columns).min()) > 0.8
    assert len({(int(r), int(c)) for r, c in zip(rows, columns, strict=True)}) > 5
