"""The pixel decoder: exact probabilities, phases, and scans that depend on nothing but their own seed."""

import math
from dataclasses import replace
from itertools import product

import pytest
import torch
from torch import Tensor

from lidargrit.core.errors import ConfigError
from lidargrit.generation.pixel_decoder.mask_network import tempered
from lidargrit.generation.pixel_decoder.phase_network import Guide, PixelDecoderConfig
from lidargrit.generation.pixel_decoder.pixel_decoder import PixelDecoder, PixelSampling, nats_to_range_bits
from lidargrit.generation.pixel_decoder.pixel_phases import (
    at_phases,
    completed_lattices,
    generated_before,
    join_phases,
    phases_of,
)
from lidargrit.nn.precision import Precision
from lidargrit.scans.condition import Observed
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import Decoded, RangeImage
from mixture_loops import density_of_v
from pixel_decoder_examples import FEATURES, random_decoded, random_decoder, random_images, tiny_sensor


def repeated(decoded: Decoded, times: int) -> Decoded:
    assert decoded.features is not None
    parts = (decoded.range_m, decoded.return_logits, decoded.features)
    range_m, logits, features = (part.expand(times, *part.shape[1:]) for part in parts)
    return Decoded(range_m, logits, decoded.sensor, features=features)


@pytest.mark.parametrize(("cell", "halvings"), [(2, (0, 0)), (4, (0, 0)), (8, (0, 0)), (4, (2, 0)), (4, (0, 2))])
def test_phases_cover_every_pixel_once(cell: int, halvings: tuple[int, int]) -> None:
    phases, count = phases_of(cell, *halvings), torch.zeros(1, 16, 32)
    for phase in phases:
        count[(..., *phase.pixels)] += 1
    assert torch.equal(count, torch.ones_like(count))
    last = sum(halvings)
    assert len(phases) == 1 + 3 * int(math.log2(cell)) + 2 * last
    before = generated_before(phases).sum((1, 2, 3, 4)).tolist()
    assert before[:4] == [0, 1, 2, 3]
    assert before[len(phases) - 2 * last :] == [2, 3] * last


@pytest.mark.parametrize("halvings", [(0, 0), (2, 0), (0, 2)])
def test_a_lattice_is_complete_after_its_number_of_phases(halvings: tuple[int, int]) -> None:
    phases, generated = phases_of(4, *halvings), torch.zeros(16, 32, dtype=torch.bool)
    ends = {count: lattice for lattice, count in completed_lattices(phases)}
    assert list(ends) == [1, 4, 7, 9, 11][: 3 + sum(halvings)]
    for number, phase in enumerate(phases, start=1):
        generated[phase.pixels] = True
        if number in ends:
            rows, columns = ends[number].rows, ends[number].columns
            assert generated[::rows, ::columns].all()
            assert int(generated.sum()) == generated[::rows, ::columns].numel()
    assert generated.all()


@pytest.mark.parametrize("halvings", [(2, 0), (0, 2)])
def test_the_last_halvings_are_of_one_side_alone(halvings: tuple[int, int]) -> None:
    phases = phases_of(4, *halvings)[-4:]
    sides = [phase.lattice.rows if halvings[0] else phase.lattice.columns for phase in phases]
    assert sides == [1] * 4
    for phase in phases:  # above and below, or left and right, are known in every phase
        (down, right), _ = phase.pairs
        assert (down, right) == ((0, -1) if halvings[0] else (-1, 0))


@pytest.mark.parametrize(("cell", "halvings"), [(8, (0, 0)), (8, (2, 0)), (4, (0, 2))])
def test_joining_phases_undoes_taking_them_apart(cell: int, halvings: tuple[int, int]) -> None:
    image, joined, phases = torch.randn(3, 16, 64), None, phases_of(cell, *halvings)
    for lattice in dict.fromkeys(phase.lattice for phase in phases):
        joined = join_phases(joined, at_phases(image, [phase for phase in phases if phase.lattice == lattice]))
    assert joined is not None
    assert torch.equal(joined, image)


@torch.no_grad()
def test_the_probabilities_of_all_masks_sum_to_one() -> None:
    sensor = tiny_sensor(4, 4)
    decoder, decoded = random_decoder(sensor, 4), random_decoded(sensor, 1)
    bits = torch.arange(2**16)[:, None] >> torch.arange(16) & 1
    masks = bits.bool().view(-1, 4, 4)
    images = RangeImage.masked(torch.full(masks.shape, 10.0), masks, sensor)
    total = 0.0
    for first in range(0, len(masks), 8192):
        some = images[first : first + 8192]
        nll = decoder(repeated(decoded, len(some)), some).mask.double().sum((1, 2))
        total += float(nll.neg().exp().sum())
    assert total == pytest.approx(1, abs=1e-4)


@torch.no_grad()
def test_sampled_masks_come_as_often_as_their_probability() -> None:
    sensor = tiny_sensor(2, 4)
    decoder, decoded = random_decoder(sensor, 2, spread=0.45), random_decoded(sensor, 1)
    masks = torch.tensor(list(product([False, True], repeat=8))).view(-1, 2, 4)
    images = RangeImage.masked(torch.full(masks.shape, 10.0), masks, sensor)
    probability = decoder(repeated(decoded, len(masks)), images).mask.sum((1, 2)).neg().exp()
    count = 20_000
    uniform = torch.rand(count, 2, 4, generator=torch.Generator().manual_seed(0))
    nothing = Observed.nothing(sensor, count)
    sampled = decoder.mask.sample(Guide.of(repeated(decoded, count)), uniform, nothing)  # all in one batch
    index = (sampled.flatten(1) * 2 ** torch.arange(7, -1, -1)).sum(1)
    seen = torch.bincount(index, minlength=len(masks)) / count
    # The mean distance of as many samples of the very distribution, by the normal approximation of each count.
    expected = float((2 * probability * (1 - probability) / (math.pi * count)).sqrt().sum())
    assert float((seen - probability).abs().sum()) < 1.25 * expected
    independent = independent_masks(probability, masks)
    assert float((independent - probability).abs().sum()) > 2 * expected


def independent_masks(probability: Tensor, masks: Tensor) -> Tensor:
    """Return the probabilities of masks whose pixels return as often, but independently."""
    marginal = (probability[:, None, None] * masks).sum(0)
    return torch.where(masks, marginal, 1 - marginal).flatten(1).prod(1)


@torch.no_grad()
@pytest.mark.parametrize(
    ("cell", "halvings", "features"),
    [(2, (0, 0), FEATURES), (8, (0, 0), FEATURES), (4, (2, 0), 0), (4, (0, 1), FEATURES), (4, (0, 1), 0)],
)
def test_a_phase_knows_of_earlier_pixels_only(cell: int, halvings: tuple[int, int], features: int) -> None:
    sensor = tiny_sensor(8, 16)
    decoder = random_decoder(sensor, cell, halvings=halvings, features=features)
    decoded = random_decoded(sensor, 2) if features else None
    truth, other = random_images(sensor, 2), random_images(sensor, 2, seed=3)
    nll = decoder(decoded, truth)
    phases = phases_of(cell, *halvings)
    for number, phase in enumerate(phases):
        later = torch.ones(8, 16, dtype=torch.bool)
        for earlier in phases[: number + 1]:
            later[earlier.pixels] = False
        mixed_mask = torch.where(later, other.return_mask, truth.return_mask)
        mixed = RangeImage.masked(torch.where(later, other.range_m + 1, truth.range_m + 1), mixed_mask, sensor)
        base = RangeImage.masked(truth.range_m + 1, truth.return_mask, sensor)
        of_mask = decoder(decoded, mixed).mask[(..., *phase.pixels)]
        assert torch.allclose(of_mask, nll.mask[(..., *phase.pixels)], atol=1e-6)
        # The range may know of the whole mask, so only later ranges change here.
        ranges = RangeImage.masked(torch.where(later, other.range_m + 3, base.range_m), truth.return_mask, sensor)
        of_range = decoder(decoded, ranges).range[(..., *phase.pixels)]
        assert torch.allclose(of_range, decoder(decoded, base).range[(..., *phase.pixels)], atol=1e-5)


@torch.no_grad()
def test_a_range_is_as_likely_as_a_loop_over_components_says() -> None:
    sensor = tiny_sensor(4, 8)
    decoder, decoded, images = random_decoder(sensor, 2), random_decoded(sensor, 1), random_images(sensor, 1)
    nll = decoder(decoded, images).range[0]
    guide, v = Guide.of(decoded), images.range_m.log1p()
    guided = decoder.range.guided(guide)
    assert decoder.range.limits_m == (sensor.range_min_m, sensor.range_max_m)
    for phase in decoder.range.phases:
        mixture = decoder.range.distributions([phase], guided, guide, images.return_mask, v)
        rows, columns = torch.arange(4)[phase.pixels[0]].tolist(), torch.arange(8)[phase.pixels[1]].tolist()
        for (i, row), (j, column) in product(enumerate(rows), enumerate(columns)):
            if not images.return_mask[0, row, column]:
                assert nll[row, column] == 0
                continue
            range_m = float(images.range_m[0, row, column])
            weights = mixture.logits[0, 0, i, j].double().softmax(0).tolist()
            centres, scales = mixture.centres[0, 0, i, j].tolist(), mixture.log_scales[0, 0, i, j].exp().tolist()
            components = list(zip(weights, centres, scales, strict=True))
            density = density_of_v(components, mixture.limits_m, math.log1p(range_m)) / (1 + range_m)
            assert float(nll[row, column]) == pytest.approx(-math.log(density), abs=1e-3)


@torch.no_grad()
def test_turning_the_sensor_turns_everything() -> None:
    sensor = tiny_sensor(8, 16)
    decoder, decoded, images = random_decoder(sensor, 4), random_decoded(sensor, 2), random_images(sensor, 2)
    assert decoded.features is not None
    turned = Decoded(
        decoded.range_m.roll(4, -1), decoded.return_logits.roll(4, -1), sensor, features=decoded.features.roll(4, -1)
    )
    plain = decoder(decoded, images)
    rolled = decoder(turned, RangeImage(images.range_m.roll(4, -1), images.return_mask.roll(4, -1), sensor))
    assert torch.allclose(plain.mask.roll(4, -1), rolled.mask, atol=1e-5)
    assert torch.allclose(plain.range.roll(4, -1), rolled.range, atol=1e-4)


@torch.no_grad()
def test_a_seed_gives_the_same_bits_whatever_its_batch() -> None:
    sensor = load_sensor("hdl64e_kitti_odometry").with_columns(64)
    decoder, decoded = random_decoder(sensor, 8), random_decoded(sensor, 5)

    def sample(*seeds: int) -> RangeImage:
        assert decoded.features is not None
        some = list(seeds)
        picked = Decoded(decoded.range_m[some], decoded.return_logits[some], sensor, features=decoded.features[some])
        return decoder.sample(picked, [torch.Generator().manual_seed(seed) for seed in seeds])

    together, apart = sample(0, 1, 2, 3, 4), [sample(seed) for seed in (4, 2)]
    assert torch.equal(together.range_m[4], apart[0].range_m[0])
    assert torch.equal(together.range_m[2], apart[1].range_m[0])
    assert torch.equal(together.return_mask, together.range_m > 0)


@torch.no_grad()
def test_16_bits_move_few_pixels_and_leave_32_bits_as_they_were() -> None:
    sensor = tiny_sensor(32, 64)
    decoder, decoded = random_decoder(sensor, 8, spread=0.06), random_decoded(sensor, 4)

    def sample(precision: Precision) -> RangeImage:
        rngs = [torch.Generator().manual_seed(seed) for seed in range(4)]
        # Random networks have many components at one range, between which a temperature would choose by rounding.
        return decoder.sample(decoded, rngs, PixelSampling(range_temperature=1.0, precision=precision))

    exact, quick = sample("fp32"), sample("bf16")
    assert quick.range_m.dtype == torch.float32
    assert not torch.equal(quick.range_m, exact.range_m)
    assert (quick.return_mask != exact.return_mask).float().mean() < 0.02
    both = quick.return_mask & exact.return_mask
    assert ((quick.range_m - exact.range_m).abs() < 0.3)[both].float().mean() > 0.95
    assert torch.equal(sample("fp32").range_m, exact.range_m)


@pytest.mark.parametrize("name", ["range_temperature", "surface_temperature", "mask_temperature"])
@torch.no_grad()
def test_a_model_has_temperatures_of_its_own(name: str) -> None:
    sensor = tiny_sensor(16, 32)
    decoder, decoded = random_decoder(sensor, 4, spread=0.06), random_decoded(sensor, 2)

    def sample(own: float, asked_for: float = 0.0) -> Tensor:
        decoder.config = replace(decoder.config, **{name: own})
        rngs = [torch.Generator().manual_seed(seed) for seed in range(2)]
        return decoder.sample(decoded, rngs, replace(PixelSampling(), **{name: asked_for})).range_m

    assert torch.equal(sample(0.1), sample(3.0, asked_for=0.1))
    assert not torch.equal(sample(0.1), sample(3.0))
    for senseless in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(ConfigError, match=f"{name}={senseless}"):
            replace(PixelDecoderConfig(), **{name: senseless})


@pytest.mark.parametrize("temperature", [0.05, 0.3, 1.0, 4.0])
def test_a_temperature_of_masks_leaves_rare_drops_and_returns_alone(temperature: float) -> None:
    """Between a tenth and nine tenths the odds, counted from these ends, are taken to a power."""
    given = torch.linspace(0, 1, 201, dtype=torch.float64)
    found = tempered(given, temperature)
    for before, after in zip(given.tolist(), found.tolist(), strict=True):
        if 0.1 < before < 0.9:
            low, high = ((before - 0.1) / 0.8) ** (1 / temperature), ((0.9 - before) / 0.8) ** (1 / temperature)
            assert after == pytest.approx(0.1 + 0.8 * low / (low + high), abs=1e-9)
        else:
            assert after == before
    assert torch.all(found.diff() >= 0)


@torch.no_grad()
def test_observed_pixels_come_back_as_they_are_and_move_their_neighbours() -> None:
    sensor = tiny_sensor(8, 16)
    decoder, decoded, images = random_decoder(sensor, 4), random_decoded(sensor, 2), random_images(sensor, 2)
    observed = torch.zeros(2, 8, 16, dtype=torch.bool)
    observed[:, ::4] = True

    def sample(known: Tensor) -> RangeImage:
        rngs = [torch.Generator().manual_seed(seed) for seed in (0, 1)]
        return decoder.sample(decoded, rngs, PixelSampling(), Observed.of_pixels(images, known))

    free, completed = sample(torch.zeros_like(observed)), sample(observed)
    assert torch.equal(completed.range_m[observed], images.range_m[observed])
    assert torch.equal(completed.return_mask[observed], images.return_mask[observed])
    assert not torch.equal(completed.range_m[~observed], free.range_m[~observed])
    assert torch.equal(sample(torch.ones_like(observed)).range_m, images.range_m)


@pytest.mark.parametrize(("halvings", "number"), [((0, 0), 3), ((0, 1), 4)])
def test_the_row_between_two_of_a_plane_is_interpolated_exactly(halvings: tuple[int, int], number: int) -> None:
    sensor = tiny_sensor(8, 8)
    decoder, decoded = random_decoder(sensor, 2, halvings=halvings), random_decoded(sensor, 1)
    # Ranges of the ground 1.7 m below the sensor, which every second of the lower rows sees.
    elevation_rad = sensor.elevation_rad.expand(8, 8)
    range_m = torch.where(elevation_rad < -0.03, 1.7 / -elevation_rad.sin().clamp(max=-0.03), 10.0)[None]
    mask = (elevation_rad < -0.03)[None]
    phase = decoder.range.phases[number]  # below a known pixel, above another
    candidates = decoder.range.candidates([phase], Guide.of(decoded), mask, torch.where(mask, range_m, 0.0).log1p())
    inner = candidates[0, 0, 0, 1:3, :].expm1()
    assert torch.allclose(inner, range_m[0][phase.pixels][1:3], rtol=1e-4)


@torch.no_grad()
@pytest.mark.parametrize(("halvings", "choices"), [((0, 0), 4), ((0, 1), 4 * 2)])
def test_the_estimate_of_a_training_step_is_right_on_average(halvings: tuple[int, int], choices: int) -> None:
    sensor = tiny_sensor(4, 8)
    decoder, decoded = random_decoder(sensor, 2, halvings=halvings), random_decoded(sensor, 2)
    images, rng = random_images(sensor, 2), torch.Generator().manual_seed(0)
    found = {round(float(decoder.estimate(decoded, images, rng)[0]), 5) for _ in range(20 * choices)}
    assert len(found) == choices  # one phase of each lattice
    assert sum(found) / choices == pytest.approx(float(decoder(decoded, images).mask.mean()), abs=1e-4)


def test_bits_of_a_return_are_those_of_a_centimetre() -> None:
    evenly = torch.tensor(math.log(2.0))  # nats of a density of 1/2 a metre, so 200 centimetres equally likely
    assert float(nats_to_range_bits(evenly)) == pytest.approx(math.log2(200), abs=1e-4)


def test_an_image_that_cells_do_not_divide_is_refused() -> None:
    with pytest.raises(ConfigError, match="cells that divide both sides"):
        PixelDecoder(PixelDecoderConfig(), tiny_sensor(12, 16), FEATURES)
    with pytest.raises(ConfigError, match="a power of 2"):
        PixelDecoderConfig(coarsest_cell=6)
    with pytest.raises(ConfigError, match="row_halvings=1000000; wanted a whole number, at least 0, at most 8"):
        PixelDecoderConfig(row_halvings=1_000_000)
    with pytest.raises(ConfigError, match="cells of 32x8"):
        PixelDecoder(PixelDecoderConfig(8, row_halvings=2), tiny_sensor(16, 32), FEATURES)
    with pytest.raises(ConfigError, match="column_halvings=1, row_halvings=2"):
        PixelDecoderConfig(column_halvings=1, row_halvings=2)
    with pytest.raises(ConfigError, match="mask_width=0"):
        PixelDecoderConfig(mask_width=0)


def test_a_decoder_without_features_is_refused() -> None:
    sensor = tiny_sensor(8, 16)
    decoded = random_decoded(sensor, 1)
    with pytest.raises(ConfigError, match="gives no features"):
        random_decoder(sensor, 4)(Decoded(decoded.range_m, decoded.return_logits, sensor), random_images(sensor, 1))
