"""The sliced Wasserstein distance against the program's numbers, scipy, slow loops and its own definition."""

import numpy as np
import pytest
import torch
from scipy import ndimage
from scipy.stats import wasserstein_distance

from lidargrit.core.errors import ConfigError
from lidargrit.evaluation.metrics import sliced_wasserstein as swd
from lidargrit.evaluation.metrics.sliced_wasserstein import SlicedWasserstein
from lidargrit.scans.projection import RangeEncoding
from lidargrit.scans.sensors import SensorModel, column_azimuths_rad, load_sensor
from lidargrit.scans.types import RangeImage

VARIANTS = ["reference", "textbook"]
SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(128)
KERNEL = np.outer([1, 4, 6, 4, 1], [1, 4, 6, 4, 1]) / 256


def rng_of(seed):
    return torch.Generator().manual_seed(seed)


def small_sensor(rows=16, columns=16, range_max_m=100.0):
    return SensorModel(
        "small", torch.linspace(0, -0.4, rows)[:, None], column_azimuths_rad(columns), 1.0, range_max_m, "spherical"
    )


def random_images(seed, count, sensor, smooth=False):
    range_m = 1.5 + 90 * torch.rand(count, sensor.height, sensor.width, generator=rng_of(seed))
    if smooth:
        range_m = range_m.cumsum(2) / sensor.width
    return RangeImage.masked(range_m, torch.rand(range_m.shape, generator=rng_of(seed + 1)) > 0.2, sensor)


def score(generated, real, **options):
    metric = SlicedWasserstein(**options)
    metric.update(real, real=True)
    metric.update(generated, real=False)
    return metric.compute()


# Against the program


@pytest.mark.shared
def test_pyramid_is_the_programs(golden):
    data = golden("swd")
    pyramid = swd.laplacian_pyramid(torch.from_numpy(data["image1"][:2, 0]), shifted=True)
    assert len(pyramid) == 3
    for level, ours in enumerate(pyramid):
        assert np.allclose(ours.numpy(), data[f"pyramid{level}"][:, 0], atol=1e-6)


@pytest.mark.shared
def test_patches_and_distance_are_the_programs(golden):
    data = golden("swd")
    for which, seed in ((1, 7), (2, 8)):  # the seeds with which these places were drawn
        key = "patch_indices" if which == 1 else "patch_indices_2"
        middle = swd.laplacian_pyramid(torch.from_numpy(data[f"image{which}"][:2, 0]), shifted=True)[1]
        positions = swd.shared_positions(swd.num_positions(*middle.shape[1:]), rng_of(seed))[None, :32]
        assert np.array_equal(positions[0].numpy(), data[key])
        ours = swd.standardised(swd.descriptors(middle, positions).flatten(0, 1), correction=1)
        assert np.allclose(ours.numpy(), data[f"desc{which}"], atol=1e-5)
    first, second, directions = (torch.from_numpy(data[key]) for key in ("desc1", "desc2", "directions"))
    assert np.isclose(swd.sliced_distance(first, second, directions), data["sliced_distance"], rtol=1e-6)


def images_of(encoded):
    encoding = RangeEncoding("linear", SENSOR.range_min_m, SENSOR.range_max_m)
    encoded = torch.from_numpy(encoded[:, 0])
    return RangeImage.masked(encoding.decode(encoded), encoded > -1, SENSOR)


@pytest.mark.shared
def test_every_seed_gives_the_programs_value_at_every_level(golden):
    data = golden("swd")
    generated, real = images_of(data["image1"]), images_of(data["image2"])
    for seed, theirs in enumerate(data["per_seed"]):
        result = score(generated, real, seed=seed)
        ours = [result.details["rows_64"], result.details["rows_32"], result.details["rows_16"], result.value]
        assert np.allclose(ours, theirs, rtol=0, atol=1e-6)


@pytest.mark.shared
def test_a_set_against_itself_is_the_programs_floor(golden):
    data = golden("swd")
    images = images_of(data["image1"])
    results = [score(images, images, seed=seed) for seed in range(20)]
    ours = [[*(r.details[f"rows_{rows}"] for rows in (64, 32, 16)), r.value] for r in results]
    assert np.allclose(np.mean(ours, axis=0), data["self_mean"], atol=1e-6)


# Against scipy and slow loops


def scipy_blur(image):
    return ndimage.convolve(image, KERNEL, mode="mirror")


@pytest.mark.parametrize(("shifted", "offset"), [(False, 0), (True, 1)])
def test_pyramid_is_that_of_a_scipy_convolution(shifted, offset):
    images = torch.randn(2, 64, 48, generator=rng_of(0))
    pyramid = swd.laplacian_pyramid(images, shifted=shifted)
    assert [tuple(level.shape) for level in pyramid] == [(2, 64, 48), (2, 32, 24)]
    for index in range(2):
        image = images[index].double().numpy()
        coarse = scipy_blur(image)[::2, ::2]
        fine = np.zeros_like(image)
        fine[offset::2, offset::2] = coarse
        assert np.allclose(pyramid[0][index], image - 4 * scipy_blur(fine), atol=1e-5)
        assert np.allclose(pyramid[1][index], coarse, atol=1e-6)


def test_textbook_pyramid_is_aligned_and_the_programs_is_not():
    ramp = torch.arange(64.0).expand(
        1, 64, 64
    )  # one more per column: what remains inside is the misplacement in columns
    inside = slice(8, -8)
    aligned, shifted = (swd.laplacian_pyramid(ramp, shifted=which)[0][:, inside, inside] for which in (False, True))
    assert aligned.abs().max() < 1e-4
    assert torch.allclose(shifted, torch.ones(()), atol=1e-4)


@pytest.mark.parametrize("shared_by_all", [True, False])
def test_descriptors_are_the_pixels_of_a_slow_loop(shared_by_all):
    images = torch.randn(3, 16, 20, generator=rng_of(0))
    positions = torch.randint(swd.num_positions(16, 20), (1 if shared_by_all else 3, 9), generator=rng_of(1))
    ours = swd.descriptors(images, positions)
    for b in range(3):
        for p in range(9):
            row, column = divmod(int(positions[0 if shared_by_all else b, p]), 20 - 6)
            for k in range(49):
                assert ours[b, p, k] == images[b, row + k // 7, column + k % 7]


@pytest.mark.parametrize("unit_length", [True, False])
def test_distance_is_scipys_on_every_direction(unit_length, monkeypatch):
    first, second = torch.randn(60, 49, generator=rng_of(0)), torch.rand(60, 49, generator=rng_of(1))
    directions = swd.random_directions(rng_of(2), unit_length=unit_length)
    if unit_length:
        assert torch.allclose(directions.norm(dim=0), torch.ones(128))
    else:
        assert torch.allclose(directions.std(dim=0), torch.ones(128))
    theirs = [wasserstein_distance((first @ d).numpy(), (second @ d).numpy()) for d in directions.T]
    assert np.isclose(swd.sliced_distance(first, second, directions), np.mean(theirs), rtol=1e-5)
    monkeypatch.setattr(swd, "_MAX_PROJECTED", 60 * 5)  # the last of the pieces is smaller than the others
    assert np.isclose(swd.sliced_distance(first, second, directions), np.mean(theirs), rtol=1e-5)


def test_distance_of_sets_on_a_line_is_that_of_a_shift():
    points = torch.randn(500, 49, generator=rng_of(0))
    directions = swd.random_directions(rng_of(1), unit_length=True)
    shift = torch.randn(49, generator=rng_of(2))
    expected = float((shift @ directions).abs().mean())  # of a shifted set, every sorted pair differs by the shift
    assert np.isclose(swd.sliced_distance(points, points + shift, directions), expected, rtol=1e-4)
    assert swd.sliced_distance(points, points.flip(0), directions) == pytest.approx(0, abs=1e-6)


def test_standardised_has_mean_0_and_deviation_1_over_all_numbers():
    patches = 5 + 3 * torch.randn(40, 49, generator=rng_of(0)) * torch.arange(1, 50)
    for correction in (0, 1):
        ours = swd.standardised(patches, correction).double().numpy()
        assert np.isclose(ours.mean(), 0, atol=1e-6)
        assert np.isclose(ours.std(ddof=correction), 1, atol=1e-5)
    assert (swd.standardised(torch.full((3, 49), 7.0), 1) == 0).all()


# The definition


@pytest.mark.parametrize("variant", VARIANTS)
def test_two_sets_of_one_kind_draw_nearer_as_they_grow(variant):
    sensor = small_sensor(rows=32, columns=32)
    few, many = (
        score(random_images(0, n, sensor), random_images(9, n, sensor), variant=variant).value for n in (8, 128)
    )
    assert many < 0.5 * few


def test_directions_of_the_program_are_seven_times_too_long():
    generated, real = random_images(0, 64, SENSOR, smooth=True), random_images(5, 64, SENSOR)
    values = [score(generated, real, variant=variant).value for variant in VARIANTS]
    assert 6 < values[0] / values[1] < 8


@pytest.mark.parametrize("variant", VARIANTS)
def test_common_offset_and_scale_go_unseen(variant):
    images = random_images(0, 16, small_sensor(32, 32))
    images = RangeImage(images.range_m.clamp(min=2.0), torch.ones_like(images.return_mask), images.sensor)
    half = RangeImage(images.range_m / 2, images.return_mask, images.sensor)
    # Textbook patches are drawn from the image itself, hence others for half the range.
    tolerance = 1e-4 if variant == "reference" else 0.1
    real = random_images(7, 16, images.sensor)
    full_value, half_value = (score(x, real, variant=variant).value for x in (images, half))
    assert half_value == pytest.approx(full_value, rel=tolerance)


def test_reference_shares_places_within_a_batch_of_128_and_draws_anew_for_the_next():
    sensor = small_sensor()
    metric = SlicedWasserstein()
    one = random_images(0, 1, sensor)
    metric.update(RangeImage.stack([one[0]] * 130), real=True)
    cut = torch.from_numpy(metric._kept[True].value())
    assert (cut[:128] == cut[0]).all()
    assert (cut[129] == cut[128]).all()
    assert not (cut[128] == cut[0]).all()
    assert torch.equal(
        cut[128].sort(0).values, cut[0].sort(0).values
    )  # all 100 places of 16x16 pixels, in another order


@pytest.mark.parametrize("variant", VARIANTS)
def test_pieces_that_straddle_a_batch_of_128_change_nothing(variant):
    sensor = small_sensor(32, 32)
    generated, real = random_images(0, 140, sensor), random_images(5, 140, sensor)
    metric = SlicedWasserstein(variant=variant)
    for start, stop in ((0, 100), (100, 133), (133, 140)):
        metric.update(generated[start:stop], real=False)
    metric.update(real, real=True)
    assert metric.compute().value == pytest.approx(score(generated, real, variant=variant).value, rel=1e-6)


def test_textbook_neither_order_nor_processes_matter_beyond_a_batch():
    sensor = small_sensor(32, 32)
    generated, real = random_images(0, 140, sensor), random_images(5, 140, sensor)
    parts = [SlicedWasserstein(variant="textbook") for _ in range(2)]
    for part, piece in zip(parts, (slice(70, 140), slice(0, 70)), strict=True):
        part.update(generated[piece], real=False)
        part.update(real[piece], real=True)
    parts[0].merge(parts[1])
    assert parts[0].compute().value == pytest.approx(score(generated, real, variant="textbook").value, rel=1e-5)


def test_reference_parts_take_positions_by_their_place():
    sensor = small_sensor(32, 32)
    generated, real = random_images(0, 140, sensor), random_images(5, 140, sensor)
    parts = [SlicedWasserstein() for _ in range(2)]
    for part, piece in zip(parts, (slice(0, 70), slice(70, 140)), strict=True):
        part.first_image = piece.start
        part.update(generated[piece], real=False)
        part.update(real[piece], real=True)
    parts[0].merge(parts[1])
    assert parts[0].compute() == score(generated, real)


@pytest.mark.parametrize("variant", VARIANTS)
def test_of_unequal_sets_the_first_n_are_compared(variant):
    generated, real = random_images(0, 9, SENSOR), random_images(5, 6, SENSOR)
    unequal, equal = score(generated, real, variant=variant), score(generated[:6], real, variant=variant)
    assert unequal.value == equal.value
    assert (unequal.num_generated, unequal.num_reference, unequal.details["num_compared"]) == (9, 6, 6)


# Mistakes


@pytest.mark.parametrize(
    ("rows", "columns", "message"),
    [
        (8, 64, r"got range images of 8x64; wanted at least 16 rows and columns"),
        (64, 90, r"got range images of 64x90; wanted rows and columns that are multiples of 4"),
    ],
)
def test_sizes_without_a_pyramid_are_refused(rows, columns, message):
    with pytest.raises(ConfigError, match=message):
        SlicedWasserstein().update(random_images(0, 2, small_sensor(rows, columns)), real=True)


def test_images_of_two_kinds_are_refused():
    metric = SlicedWasserstein()
    metric.update(random_images(0, 2, small_sensor(16, 32)), real=True)
    with pytest.raises(ConfigError, match=r"got range images of 16x16 .* wanted 16x32 between 1 and 100 m"):
        metric.update(random_images(0, 2, small_sensor(16, 16)), real=False)
    with pytest.raises(ConfigError, match="between 1 and 95 m"):
        metric.update(random_images(0, 2, small_sensor(16, 32, range_max_m=95.0)), real=False)
