"""What is known of a scan: its checks, the patterns of observed pixels, and what stands in a completed scan."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from lidargrit.core.determinism import derive_seed
from lidargrit.core.errors import ConfigError, ScanError, UsageError
from lidargrit.inference.complete.patterns import Pattern
from lidargrit.scans.condition import Observed
from lidargrit.scans.fills import fill_from_nearest, fill_lacking
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)


def scans(count: int = 2) -> RangeImage:
    rng = torch.Generator().manual_seed(1)
    size = (count, 64, 32)
    mask = torch.rand(size, generator=rng) < 0.8
    return RangeImage.masked(
        2 + 40 * torch.rand(size, generator=rng), mask, SENSOR, {"reflectance": torch.rand(size, generator=rng)}
    )


def test_what_was_observed_stands_bit_for_bit_and_the_rest_is_generated():
    images, generated = scans(), RangeImage.masked(torch.full((2, 64, 32), 7.0), scans().return_mask.roll(1), SENSOR)
    observed = torch.rand(2, 64, 32) < 0.3
    known = Observed.of_pixels(images, observed)
    assert known.kinds == {"pixels"}
    done = known.put_into(generated)
    assert torch.equal(done.range_m[observed], images.range_m[observed])
    assert torch.equal(done.range_m[~observed], generated.range_m[~observed])
    assert Observed.nothing(SENSOR, 2).kinds == frozenset()
    assert torch.equal(Observed.nothing(SENSOR, 2).put_into(generated).range_m, generated.range_m)


def test_scans_of_different_numbers_of_images_make_one_batch():
    alone, two, three = (
        replace(Observed.nothing(SENSOR, len(seeds)), earlier_seeds=torch.tensor(seeds) if len(seeds) > 1 else None)
        for seeds in ([[]], [[-1], [7]], [[-1, -1], [-1, 4], [4, 5]])
    )
    batch = Observed.cat([alone, two, three, two[1:]])
    assert batch.earlier_seeds is not None
    assert batch.earlier_seeds.tolist() == [[-1, -1], [-1, -1], [-1, 7], [-1, -1], [-1, 4], [4, 5], [-1, 7]]
    assert Observed.cat([alone, alone]).earlier_seeds is None


def test_of_clean_surfaces_only_what_returned_is_kept():
    images = scans()
    known, generated = Observed.of_surfaces(images), RangeImage.masked(images.range_m + 1, images.return_mask, SENSOR)
    assert known.kinds == {"surfaces"}  # a beam that meets nothing is known not to return, which is no range
    dropped = RangeImage.masked(generated.range_m, generated.return_mask.roll(1) & generated.return_mask, SENSOR)
    assert torch.equal(known.put_into(dropped).range_m, images.range_m * dropped.return_mask)


def test_scans_of_two_sensors_are_no_batch():
    other = replace(SENSOR, elevation_rad=SENSOR.elevation_rad + 0.01)
    images, theirs = scans(), replace(scans(), sensor=other)
    nothing = torch.zeros_like(images.return_mask)
    for join in (
        lambda: RangeImage.cat([images, theirs]),
        lambda: RangeImage.stack([images[0], theirs[0]]),
        lambda: Observed.cat([Observed.of_pixels(each, nothing) for each in (images, theirs)]),
    ):
        with pytest.raises(ConfigError, match="images of the sensors"):
            join()


def test_conditions_that_cannot_be_are_refused():
    images = scans()
    with pytest.raises(ConfigError, match=r"^got observed pixels of shape .*; wanted \(2, 64, 32\) and torch.bool"):
        Observed.of_pixels(images, torch.ones(1, 64, 32, dtype=torch.bool))
    every = torch.ones(2, 64, 32, dtype=torch.bool)
    with pytest.raises(ScanError, match="an observed range of 0 metres"):
        Observed(images.range_m, every, images.return_mask, every, SENSOR)
    with pytest.raises(ScanError, match="an observed return of unknown range"):
        Observed(images.range_m, ~every, images.return_mask, every, SENSOR)


@pytest.mark.usefixtures("untyped")
def test_reflectance_labels_and_unknown_pixels_that_cannot_be_are_refused():
    images = scans()
    every, bright = torch.ones(2, 64, 32, dtype=torch.bool), images.reflectance
    assert bright is not None
    for wrong in (bright * 255, bright - 1, bright * torch.nan):
        with pytest.raises(ScanError, match=r"reflectance is NaN, below 0 or above 1; wanted values in \[0, 1\]"):
            Observed.of_pixels(images.with_planes(reflectance=wrong), every)
    beyond = torch.where(images.return_mask, bright, 2.0)
    mask = images.return_mask
    assert len(Observed(images.range_m, mask, mask, mask, SENSOR, {"reflectance": beyond})) == 2, (
        "values elsewhere have no influence"
    )
    with pytest.raises(ConfigError, match=r"^got label of type torch.float32; wanted whole numbers"):
        Observed.of_pixels(images.with_planes(label=bright), every)
    with pytest.raises(ConfigError, match=r"^got unknown pixels of .* and type torch.float32; wanted .*torch.bool"):
        Observed.of_surfaces(images, every.float())


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16])
def test_images_and_conditions_are_kept_in_32_bits(dtype):
    images = scans()
    assert images.reflectance is not None
    given = replace(images, range_m=images.range_m.to(dtype), planes={"reflectance": images.reflectance.to(dtype)})
    assert given.range_m.dtype == given.reflectance.dtype == torch.float32
    mask = images.return_mask
    planes = {"reflectance": images.reflectance.to(dtype)}
    known = Observed(images.range_m.to(dtype), mask, mask, mask, SENSOR, planes)
    assert known.range_m.dtype == known.reflectance.dtype == torch.float32
    assert torch.equal(known.range_m, given.range_m)


def test_patterns_choose_rows_sectors_pixels_and_files(tmp_path):
    image = scans(1)[0]
    rows = Pattern("rows:4").mask(image)
    assert rows.any(1).nonzero()[:, 0].tolist() == list(range(2, 64, 4))
    sector = Pattern("sector:45,315").mask(image)[0]
    ahead = image.sensor.azimuth_rad[0].rad2deg().abs() < 45
    assert torch.equal(sector, ~ahead)
    assert Pattern("sector:-45,45").mask(image)[0].sum() == 32 - sector.sum()
    pixels = [Pattern("pixels:0.1").mask(image, seed) for seed in (0, 0, 1)]
    assert torch.equal(pixels[0], pixels[1])
    assert not torch.equal(pixels[0], pixels[2])
    assert 0.07 < float(pixels[0].float().mean()) < 0.13
    completion = torch.rand(pixels[0].shape, generator=torch.Generator().manual_seed(derive_seed(0, 0))) < 0.1
    assert 0.005 < float((pixels[0] & completion).float().mean()) < 0.015, "a completion has other random numbers"
    assert torch.equal(Pattern("returns").mask(image), image.return_mask)
    np.save(tmp_path / "mask.npy", rows.numpy().astype(np.uint8))
    of_file = Pattern(f"{tmp_path}/mask.npy")
    assert torch.equal(of_file.mask(image), rows)
    before = of_file.identity()
    np.save(tmp_path / "mask.npy", sector.expand(rows.shape).numpy().astype(np.uint8))
    assert of_file.identity().keys() == before.keys() == {"observed", "observed_sha256"}
    assert of_file.identity() != before, "a folder of completions is not continued with another mask"
    assert Pattern("rows:4").identity() == {"observed": "rows:4"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("columns:4", "--observed columns:4; wanted rows:4, "),
        ("rows:1", "--observed rows:1; wanted rows:N with a whole N from 2 to 64"),
        ("rows:x", "--observed rows:x; wanted rows:N"),
        ("sector:4", "--observed sector:4; wanted sector:A,B"),
        ("sector:9,9", "--observed sector:9,9; wanted sector:A,B"),
        ("pixels:1", "--observed pixels:1; wanted pixels:SHARE between 0 and 1"),
        ("pixels:nan", "--observed pixels:nan; wanted pixels:SHARE"),
        ("nowhere.npy", r"--observed nowhere.npy, which cannot be used \(it is no file\); wanted an .npy of 64x32"),
        ("small.npy", "--observed .*small.npy, a mask of 3x4 bool; wanted an .npy of 64x32"),
        ("all.npy", "--observed .*all.npy, by which all pixels are observed; wanted some pixels that are not"),
        ("none.npy", "a scan, of which --observed .*none.npy observes no return; wanted some returns"),
    ],
)
def test_observed_words_that_cannot_be_are_refused_in_one_line(text, message, tmp_path):
    for name, mask in (("small", np.ones((3, 4), bool)), ("all", np.ones((64, 32))), ("none", np.zeros((64, 32)))):
        np.save(tmp_path / f"{name}.npy", mask)
    text = f"{tmp_path}/{text}" if text.endswith(".npy") and text != "nowhere.npy" else text
    with pytest.raises((UsageError, ScanError), match=f"^got {message}"):
        Pattern(text).mask(scans(1)[0])


def test_the_nearest_observed_pixel_is_that_of_the_smallest_angle_around_the_circle():
    images = RangeImage.masked(torch.zeros(1, 64, 32) + 9, torch.ones(1, 64, 32, dtype=torch.bool), SENSOR)
    observed = torch.zeros_like(images.return_mask)
    observed[:, :, 30] = True
    filled = fill_from_nearest(images, observed)
    assert bool((filled.range_m == 9).all())
    images.range_m[0, 20, 4], images.range_m[0, 32, 5] = 5.0, 7.0
    observed[:] = False
    observed[0, 20, 4], observed[0, 32, 5] = True, True
    filled = fill_from_nearest(images, observed)
    assert float(filled.range_m[0, 32, 3]) == 5.0  # 12 rows are 4 degrees, and one column is 11
    assert float(filled.range_m[0, 26, 31]) == 5.0
    assert not fill_from_nearest(images, torch.zeros_like(observed)).return_mask.any()


def test_what_was_not_observed_has_no_influence_where_nothing_returned():
    none, every = torch.zeros(1, 64, 32, dtype=torch.bool), torch.ones(1, 64, 32, dtype=torch.bool)
    stray = torch.full((1, 64, 32), 0.7)
    known = Observed(9 * stray, none, none, every, SENSOR, {"reflectance": stray, "label": torch.full((1, 64, 32), 50)})
    filled = fill_lacking(RangeImage(9 * stray, every, SENSOR), known)
    assert torch.equal(filled.reflectance, torch.zeros(1, 64, 32))
    assert not filled.label.any()
