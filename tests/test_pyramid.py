"""The pyramid of nearest ranges: its levels, its samples and its bits."""

import math
from dataclasses import replace

import pytest
import torch

from lidargrit.core.errors import ConfigError
from lidargrit.generation.pixel_decoder.pixel_decoder import PixelSampling
from lidargrit.generation.pixel_decoder.pixel_networks import LOGIT_BOUND
from lidargrit.generation.range_steps import RangeSteps
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import TYPICAL_LOG_RANGE, RangeImage
from lidargrit.systems.pyramid.network import halved_sensor, nearest_of_four
from lidargrit.systems.pyramid.system import Pyramid, guides_of, images_of, levels_of

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(64, 1)


def pyramid():
    torch.manual_seed(0)
    return Pyramid(replace(Pyramid.smallest_config(SENSOR), levels=3), SENSOR)


def some_images(count=2):
    rng = torch.Generator().manual_seed(0)
    range_m = 2 + 60 * torch.rand(count, SENSOR.height, SENSOR.width, generator=rng) ** 3
    return RangeImage.masked(range_m, torch.rand(range_m.shape, generator=rng) < 0.4, SENSOR)


def test_a_coarser_pixel_has_the_nearest_range_of_its_four_and_a_ray_in_their_middle():
    images, halved = some_images(), halved_sensor(SENSOR)
    coarser = nearest_of_four(images, halved)
    for row in range(0, SENSOR.height, 2):
        for column in range(0, SENSOR.width, 2):
            four = images.range_m[0, row : row + 2, column : column + 2]
            returned = four[four > 0]
            expected = float(returned.min()) if len(returned) else 0.0
            assert float(coarser.range_m[0, row // 2, column // 2]) == expected
    assert torch.equal(coarser.return_mask, coarser.range_m > 0)
    middle = (SENSOR.elevation_rad[4] + SENSOR.elevation_rad[5]) / 2
    torch.testing.assert_close(halved.elevation_rad[2], middle)
    torch.testing.assert_close(halved.azimuth_rad[:, 3], SENSOR.azimuth_rad[:, 6:8].mean(1))


def test_a_cell_without_a_return_tells_that_none_of_its_pixels_returns():
    model, images = pyramid(), some_images()
    levels = levels_of(model.levels)
    of_levels = images_of(levels, images)
    with torch.no_grad():
        guide = guides_of(levels, of_levels)[0]
    assert guide is not None
    empty = ~of_levels[1].return_mask.repeat_interleave(2, 1).repeat_interleave(2, 2)
    assert empty.any()
    assert bool((guide.return_logits[empty] == -LOGIT_BOUND).all())
    near = of_levels[1].range_m.repeat_interleave(2, 1).repeat_interleave(2, 2)
    torch.testing.assert_close(guide.range_m[~empty], near[~empty])


def test_suggested_ranges_are_those_of_the_cell_the_ground_and_the_cells_next_to_the_pixel():
    model, images = pyramid(), some_images(1)
    level = levels_of(model.levels)[0]
    coarser = nearest_of_four(images, halved_sensor(SENSOR))
    found = level.suggested_m(coarser)[0]
    height, width = coarser.range_m.shape[1:]

    def at(row, column):
        row, column = min(max(row, 0), height - 1), column % width
        return float(coarser.range_m[0, row, column]) if bool(coarser.return_mask[0, row, column]) else None

    for row, column in [(0, 0), (17, 30), (63, 63), (40, 0), (41, 1), (62, 63), (5, 12)]:
        cell, side, over = (row // 2, column // 2), (1 if column % 2 else -1), (1 if row % 2 else -1)
        own = at(*cell) or math.expm1(TYPICAL_LOG_RANGE)
        beside = at(cell[0], cell[1] + side) or own
        above = at(cell[0] + over, cell[1]) or own
        across = at(cell[0] + over, cell[1] + side) or own
        here, lower = (-math.sin(float(SENSOR.elevation_rad[index])) for index in (row, 2 * cell[0] + 1))
        farther = lower / here if here > 0 else 1.0
        ground = own * farther if farther < 3 else own
        expected = torch.tensor([own, ground, beside, above, across])
        torch.testing.assert_close(found[:, row, column], expected, rtol=1e-4, atol=1e-4)


def test_bits_are_those_of_every_level_given_the_coarser_one():
    model, images = pyramid(), some_images(1)
    bits = model.bits(images, step_mm=10)
    steps = RangeSteps(SENSOR, 10)
    levels, total = levels_of(model.levels), 0.0
    pyramid_images = images_of(levels, steps.round(images))
    with torch.no_grad():
        for level, of_level, guide in zip(levels, pyramid_images, guides_of(levels, pyramid_images), strict=True):
            nll = level.pixels(guide, of_level, steps)
            total += float(nll.mask.sum() + nll.range.sum()) / math.log(2)
    found = sum(float(part) for part in bits.per_scan().values())
    assert found == pytest.approx(total, rel=1e-4)
    assert bits.is_whole


def test_a_training_step_reaches_every_level_and_the_loss_falls():
    model, images = pyramid(), some_images(8)
    objective, rng = model.objective("levels"), torch.Generator().manual_seed(0)
    optimiser = torch.optim.Adam(objective.parameters(), 1e-2)
    before = {name: weight.clone() for name, weight in objective.state_dict().items()}
    losses = []
    for _ in range(12):
        terms = objective(Example(images), rng)
        optimiser.zero_grad()
        terms["loss"].backward()
        optimiser.step()
        losses.append(float(terms["loss"].detach()))
    assert losses[-1] < losses[0]
    moved = {name.split(".")[1] for name, weight in objective.state_dict().items() if not weight.equal(before[name])}
    assert moved == {"0", "1", "2"}


def test_scans_of_which_no_level_is_sampled_are_the_true_ones_and_others_keep_the_coarser_levels():
    model, images = pyramid(), some_images()
    model.eval()
    assert torch.equal(model.resample(images, [0, 1], levels=0).range_m, images.range_m)
    one = model.resample(images, [0, 1], levels=1)
    assert not torch.equal(one.range_m, images.range_m)
    assert torch.equal(one.range_m[1], model.resample(images[[1]], [1], levels=1).range_m[0])
    empty = ~nearest_of_four(images, halved_sensor(SENSOR)).return_mask.repeat_interleave(2, 1).repeat_interleave(2, 2)
    assert float(one.return_mask[empty].float().mean()) < 0.02  # a cell without a return gets next to none
    sampled = model.resample(images, [5, 6], levels=3)
    assert torch.equal(sampled.range_m, model.sample([5, 6]).range_m)


def test_sizes_that_the_levels_cannot_halve_are_refused():
    with pytest.raises(ConfigError, match="for 7 levels"):
        Pyramid(replace(Pyramid.smallest_config(SENSOR), levels=7), SENSOR)


def test_coarser_levels_have_a_temperature_of_their_own_and_follow_the_one_that_is_asked_for():
    smallest = pyramid().config
    config = replace(smallest, pixels=replace(smallest.pixels, range_temperature=0.7), coarse_range_temperature=0.2)
    asked = PixelSampling(range_temperature=0.7)

    def sampled_m(coarse_temperature, sampling=None):
        torch.manual_seed(0)
        model = Pyramid(replace(config, coarse_range_temperature=coarse_temperature), SENSOR)
        return model.sample([5], sampling=sampling).range_m

    torch.testing.assert_close(sampled_m(0.7), sampled_m(0.2, asked), rtol=0, atol=0)
    assert not torch.equal(sampled_m(0.2), sampled_m(0.2, asked))
