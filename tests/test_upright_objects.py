"""Poles, trunks and windows of vehicles that are still there in what is made of labelled images."""

import sys
from pathlib import Path

import pytest
import torch

from lidargrit.core.errors import ConfigError
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks" / "relay"))

from upright_objects import kept_objects, upright_objects
from windows import kept_windows

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(64, 1)


def street(poles):
    """Return an image of a wall 30 m away, with things of (class, first column, columns, rows) 10 m away before it."""
    range_m, label = torch.full((1, 64, 64), 30.0), torch.full((1, 64, 64), 50)
    for kind, column, columns, rows in poles:
        pixels = (0, slice(10, 10 + rows), slice(column, column + columns))
        range_m[pixels], label[pixels] = 10.0, kind
    return RangeImage(range_m, range_m > 0, SENSOR, {"label": label})


def test_poles_and_trunks_are_upright_objects_and_nothing_else_is():
    image = street([(80, 5, 2, 30), (71, 20, 4, 20), (80, 40, 1, 39), (80, 50, 8, 10), (30, 60, 2, 30)])
    numbers = torch.from_numpy(upright_objects(image)[0])
    assert numbers.max() == 2, "39 pixels are too few, 8 columns of 10 rows are not upright, and a person is no pole"
    assert set(numbers[15, 5:7].tolist()) == {1}
    assert set(numbers[15, 20:24].tolist()) == {2}


@pytest.mark.parametrize(("error", "dropped", "kept"), [(0.4, 0, 1), (0.6, 0, 0), (0.0, 23, 1), (0.0, 25, 0)])
def test_an_object_stands_if_six_tenths_of_its_pixels_are_within_5_percent(error, dropped, kept):
    truth = street([(80, 5, 2, 30)])
    made = RangeImage(truth.range_m.clone(), truth.return_mask.clone(), SENSOR)
    made.range_m[0, 10:40, 5:7] += error
    made.return_mask[0, 10 : 10 + (dropped + 1) // 2, 5] = False
    made.return_mask[0, 10 : 10 + dropped // 2, 6] = False
    found = kept_objects(truth, RangeImage.masked(made.range_m, made.return_mask, SENSOR))
    assert (found.kept, found.total) == (kept, 1)
    assert found.share_of_pixels == pytest.approx((error < 0.5) * (60 - dropped) / 60)


def test_images_without_labels_are_refused():
    image = street([])
    with pytest.raises(ConfigError, match="without labels"):
        upright_objects(RangeImage(image.range_m, image.return_mask, SENSOR))


def with_windows(*opened):
    """Return a car 10 m away from column 20 to 39, whose rows 14 to 17 return nothing in some columns."""
    image = street([(10, 20, 20, 20)])
    for first, end in opened:
        image.range_m[0, 14:18, first:end] = 0
    return RangeImage.masked(image.range_m, image.range_m > 0, SENSOR, image.planes)


@pytest.mark.parametrize(
    ("made", "overlap", "half"),
    [([(24, 34)], 1, 1), ([(24, 29)], 0.5, 1), ([(24, 28)], 0.4, 0), ([(22, 38)], 10 / 16, 1), ([], 0, 0)],
)
def test_windows_overlap_by_intersection_over_union(made, overlap, half):
    found = kept_windows(with_windows((24, 34)), with_windows(*made))
    assert found.overlap == pytest.approx(overlap)
    assert (found.half, found.total) == (half, 1)
    # Of 360 true pixels those are lost that are open beside the true window.
    assert found.share_of_pixels == pytest.approx(1 - 4 * sum(max(0, 24 - a) + max(0, b - 34) for a, b in made) / 360)


def test_a_hole_of_five_pixels_and_one_in_a_corner_are_no_windows():
    image = with_windows()
    image.return_mask[0, 14, 24:29] = False
    image.return_mask[0, 10:14, 20:24] = False
    assert kept_windows(image, image).total == 0
    image.return_mask[0, 14, 29] = False
    assert kept_windows(image, image).total == 1
