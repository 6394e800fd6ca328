"""Augmentations: range and mask change together, and what comes in from outside is no return."""

import pytest
import torch

from lidargrit.core.errors import ConfigError
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


def labelled(seed, columns=16):
    """Return eight images with labels of roads, buildings, cars (with instances), riders and people."""
    rng, sensor = torch.Generator().manual_seed(seed), SENSOR.with_columns(columns)
    size = (8, sensor.height, columns)
    images = RangeImage.masked(torch.rand(size, generator=rng) * 50 + 1, torch.rand(size, generator=rng) < 0.7, sensor)
    label = torch.tensor([40, 50, 10 + (3 << 16), 253, 30])[torch.randint(5, size, generator=rng)]
    return images.with_planes(label=torch.where(images.return_mask, label, 0))


def test_paste_shows_nearer_vehicles_and_people_of_another_scan():
    images, others = labelled(0), labelled(1)
    pasted = augment(Example(images), ("paste",), torch.Generator().manual_seed(0), lambda: others).images
    unchanged = 0
    for one, before, other in zip(pasted, images, others, strict=True):
        if torch.equal(one.range_m, before.range_m):
            unchanged += 1
            continue
        fitting = 0
        for shift in range(16):
            wanted_m, wanted = before.range_m.clone(), before.label.clone()
            for row in range(64):
                for column in range(16):
                    range_m, label = (float(other.range_m[row, column - shift]), int(other.label[row, column - shift]))
                    own_m = float(before.range_m[row, column])
                    if label & 0xFFFF in (10, 253, 30) and range_m > 0 and (own_m == 0 or range_m < own_m):
                        wanted_m[row, column], wanted[row, column] = range_m, label
            fitting += torch.equal(one.range_m, wanted_m) and torch.equal(one.label, wanted)
        assert fitting == 1
        assert torch.equal(one.return_mask, one.range_m > 0)
    assert 1 <= unchanged <= 7
    bare = Example(images_of(1))
    with pytest.raises(ConfigError, match=r"^got the augmentation paste of scans without labels; wanted scans with"):
        augment(bare, ("paste",), torch.Generator(), lambda: bare.images)


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
