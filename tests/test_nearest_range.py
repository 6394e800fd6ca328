"""Tokens of the nearest range of each cell: what they name, and what is decoded of them."""

import math
from dataclasses import replace
from itertools import product

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from lidargrit.core.errors import ConfigError
from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.generator import load
from lidargrit.generation.pixel_decoder.phase_network import PixelDecoderConfig
from lidargrit.generation.pixel_decoder.pixel_decoder import PixelDecoder, PixelSampling
from lidargrit.generation.pixel_decoder.pixel_phases import at_phases
from lidargrit.generation.pixel_decoder.range_mixture import RangeMixture
from lidargrit.generation.settings import Preset, TrainingConfig
from lidargrit.generation.tokenizers.nearest_range import NearestRangeConfig, NearestRangeTokenizer
from lidargrit.nn.transformer import TransformerConfig
from lidargrit.scans.condition import Observed
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage, TokenGrid
from lidargrit.systems.lidargrit.system import LidarGritConfig
from lidargrit.training import train
from tiny_runs import learn

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(64, 1)
CONFIG = NearestRangeConfig(cell_rows=8, cell_columns=4, part_rows=1, part_columns=4, width=8, blocks=1, features=4)

PIXELS = PixelDecoderConfig(
    mask_features=2, range_features=2, mask_width=8, range_width=8, blocks=1, decoded_components=True
)


def test_operations_of_decoding_are_those_that_torch_counts():
    tokenizer = NearestRangeTokenizer(CONFIG, SENSOR)
    tokens = TokenGrid(torch.zeros((1, *tokenizer.grid_size), dtype=torch.long), tokenizer.num_codes)
    with FlopCounterMode(display=False) as counter:
        tokenizer.decode(tokens)
    assert tokenizer.decoding_flops() == counter.get_total_flops()


def test_features_tell_codes_apart_and_those_of_near_levels_or_of_most_parts_in_common_are_alike():
    tokenizer = NearestRangeTokenizer(replace(CONFIG, part_columns=2), SENSOR)
    features, group_size = tokenizer.code_features()
    patterns = ["farther nearest", "nearest farther", "nearest nearest", "nearest dropped", "dropped nearest"]
    assert features.shape[0] == tokenizer.num_codes == 1 + 128 * len(patterns)
    assert group_size == len(patterns), "codes of a group share their level"
    assert len(features.unique(dim=0)) == tokenizer.num_codes
    directions = features / features.norm(dim=1, keepdim=True)

    def alike(one, other):
        codes = [1 + level * len(patterns) + patterns.index(pattern) for level, pattern in (one, other)]
        return float(directions[codes[0]] @ directions[codes[1]])

    near = "nearest nearest"
    assert alike((40, near), (41, near)) > alike((40, near), (44, near)) > alike((40, near), (90, near))
    assert alike((40, near), (40, "nearest farther")) > alike((40, "dropped nearest"), (40, "nearest farther"))
    assert float((directions[1:] @ directions[0]).abs().max()) == 0  # an empty cell is like no other


def tokens_by_loop(image, config):
    """Return the tokens of one image, cell by cell and part by part."""
    range_m, found = image.range_m.tolist(), []
    low, high = math.log(SENSOR.range_min_m), math.log(SENSOR.range_max_m)
    for top in range(0, SENSOR.height, config.cell_rows):
        row = []
        for left in range(0, SENSOR.width, config.cell_columns):
            cell = [line[left : left + config.cell_columns] for line in range_m[top : top + config.cell_rows]]
            returned = [r for line in cell for r in line if r > 0]
            if not returned:
                row.append(0)
                continue
            nearest, parts = min(returned), []
            high_of_part, wide = config.cell_rows // config.part_rows, config.cell_columns // config.part_columns
            for down in range(config.part_rows):
                for right in range(config.part_columns):
                    lines = cell[down * high_of_part : (down + 1) * high_of_part]
                    rays = [r for line in lines for r in line[right * wide : (right + 1) * wide]]
                    part = [r for r in rays if r > 0]
                    close = sum(r <= 1.07 * nearest for r in part)
                    parts.append((close / len(part) if part else 0.0, close, len(part) < 0.5 * len(rays)))
            most = max(range(len(parts)), key=lambda number: parts[number][0] + 1e-3 * parts[number][1])
            states = tuple(
                "nearest" if number == most else "dropped" if drops else "nearest" if share >= 0.5 else "farther"
                for number, (share, _, drops) in enumerate(parts)
            )
            every = product(["farther", "nearest", "dropped"], repeat=len(parts))
            patterns = [pattern for pattern in every if "nearest" in pattern]
            level = math.floor((math.log(nearest) - low) / (high - low) * config.levels)
            row.append(1 + min(level, config.levels - 1) * len(patterns) + patterns.index(states))
        found.append(row)
    return torch.tensor(found)


def some_images(count=3, seed=0):
    rng = torch.Generator().manual_seed(seed)
    range_m = 2 + 60 * torch.rand(count, SENSOR.height, SENSOR.width, generator=rng) ** 3
    mask = torch.rand(range_m.shape, generator=rng) < 0.7
    mask[:, 8:24, 8:20] = False  # cells without a return
    return RangeImage.masked(range_m, mask, SENSOR)


def a_pole_before_a_wall():
    range_m = torch.full((1, SENSOR.height, SENSOR.width), 30.0)
    range_m[:, 16:48, 21] = 9.0  # one column wide, in cells that are four wide
    return RangeImage.masked(range_m, torch.ones(range_m.shape, dtype=torch.bool), SENSOR)


@pytest.mark.parametrize("sizes", [(8, 4, 1, 4), (8, 4, 2, 2), (8, 4, 4, 1), (8, 4, 1, 1), (4, 1, 4, 1)])
def test_tokens_are_those_of_a_loop_over_cells(sizes):
    config = NearestRangeConfig(*sizes, levels=50, width=8, blocks=1, features=4)
    images = some_images()
    tokens = NearestRangeTokenizer(config, SENSOR).encode(images).tokens
    assert (tokens == 0).any()
    for index in range(len(images)):
        assert torch.equal(tokens[index], tokens_by_loop(images[index], config))


def test_every_code_is_decoded_within_the_limits_and_a_quarter_turn_turns_what_is_decoded():
    tokenizer = NearestRangeTokenizer(CONFIG, SENSOR)
    grid = torch.linspace(0, tokenizer.num_codes - 1, 128).long().reshape(1, *tokenizer.grid_size)
    with torch.no_grad():
        decoded = tokenizer.decode(TokenGrid(grid, tokenizer.num_codes))
        turned = tokenizer.decode(TokenGrid(grid.roll(4, 2), tokenizer.num_codes))
    assert float(decoded.range_m.min()) >= SENSOR.range_min_m * 0.999
    assert float(decoded.range_m.max()) <= SENSOR.range_max_m * 1.001
    torch.testing.assert_close(turned.range_m, decoded.range_m.roll(16, 2))


def test_pixels_are_told_which_parts_are_nearest_and_which_are_dropped():
    config = replace(CONFIG, part_rows=2, part_columns=2)
    range_m = torch.full((1, SENSOR.height, SENSOR.width), 10.0)
    range_m[:, 8:12, 6:8] = 0.0  # the upper right quarter of one cell is dropped
    range_m[:, 20:24, 4:6] = 30.0  # and the lower left of another is farther
    images = RangeImage.masked(range_m, range_m > 0, SENSOR)
    tokenizer = NearestRangeTokenizer(config, SENSOR).eval()
    with torch.no_grad():
        features = tokenizer.decode(tokenizer.encode(images)).features
    assert features is not None
    nearest, returned, dropped = (features[:, -3:] + 0.5).unbind(1)
    assert torch.equal(nearest > 0.5, range_m == 10)
    assert torch.equal(dropped > 0.5, range_m == 0)
    assert bool((returned > 0.5).all())


def test_a_pole_keeps_its_range_before_anything_is_learned_whatever_stands_behind_it():
    images = a_pole_before_a_wall()
    decoded = NearestRangeTokenizer(CONFIG, SENSOR).reconstruct(images)
    error = (decoded.range_m - images.range_m).abs() / images.range_m
    assert float(error[:, 16:48, 21].max()) < 0.03
    assert float(error[..., 32:].max()) < 0.03, "half a level is at most 2 %"


def test_a_generator_over_such_tokens_trains_with_a_pixel_decoder_samples_and_tells_bits(tmp_path):
    config = LidarGritConfig(
        CONFIG,
        TransformerConfig(layers=1, heads=2, width=16),
        PIXELS,
    )
    fit = TrainingConfig(scans=8, batch_size=4, learning_rate=1e-2, average_over_scans=0)
    data = DataConfig(("simulated:6:train",), ("simulated:2:val",), columns=512, column_stride=8)
    stages = {"tokenizer": fit, "transformer": fit, "pixels": fit}
    preset = Preset(title="", generator="lidargrit", model=config, data=data, training=stages)
    trained = train(preset, tmp_path / "run")
    images = trained.sample([0, 1])
    assert torch.equal(load(tmp_path / "run").sample([1]).range_m[0], images.range_m[1])
    bits = trained.bits(images, step_mm=10).per_scan()
    assert all(float(part.min()) > 0 and bool(part.isfinite().all()) for part in bits.values())


def test_the_loss_falls_and_tells_the_share_of_ranges_within_5_percent():
    torch.manual_seed(0)
    tokenizer, images = NearestRangeTokenizer(CONFIG, SENSOR), some_images()
    losses = [terms["loss"] for terms in learn(tokenizer, images, range(30), 1e-2)]
    assert losses[-1] < 0.8 * losses[0]
    decoded, mask = tokenizer.decode(tokenizer.encode(images)), images.return_mask
    within = ((decoded.range_m - images.range_m).abs() <= 0.05 * images.range_m)[mask].float().mean()
    torch.testing.assert_close(tokenizer(Example(images), torch.Generator())["within_5_percent"], within)


def test_a_pixel_decoder_is_no_worse_than_the_distribution_that_the_tokens_tell_before_it_is_trained():
    tokenizer, images = NearestRangeTokenizer(CONFIG, SENSOR).eval(), a_pole_before_a_wall()
    pixels = PixelDecoder(PIXELS, SENSOR, tokenizer.num_features, tokenizer.num_components).eval()
    with torch.no_grad():
        decoded = tokenizer.decode(tokenizer.encode(images))
        per_return = pixels(decoded, images).range.sum() / images.return_mask.sum()
        of_tokens = tokenizer(Example(images), torch.Generator())["range_nats"]
    assert float(per_return) < float(of_tokens) + 0.1


def test_what_neighbours_suggest_is_weighed_by_the_probability_that_the_tokens_give_it():
    tokenizer, images = NearestRangeTokenizer(CONFIG, SENSOR).eval(), a_pole_before_a_wall()
    sizes = SENSOR, tokenizer.num_features, tokenizer.num_components
    plain, weighed = PixelDecoder(PIXELS, *sizes).eval(), PixelDecoder(replace(PIXELS, weighed_components=True), *sizes)
    weighed.load_state_dict(plain.state_dict())
    phases = plain.range.by_lattice()[-1]
    with torch.no_grad():
        decoded = tokenizer.decode(tokenizer.encode(images))
        of = []
        for pixels in (plain, weighed.eval()):
            guide = pixels.guide(decoded, 1)
            guided = pixels.range.guided(guide)
            of.append(pixels.range.distributions(phases, guided, guide, images.return_mask, images.range_m.log1p()))
        components = torch.stack([decoded.components[(..., *phase.pixels)] for phase in phases])
    added, pole = of[1].logits - of[0].logits, at_phases(images.range_m == 9, phases)
    own = slice(0, added.shape[-1] - tokenizer.num_components)  # those that are not decoded
    assert not added[..., own.stop :].any()
    for phase, scan, row, column in pole.nonzero().tolist()[::7]:
        logits, centres, log_scales = components[phase, scan, :, :, row, column].double()
        for number in range(own.start, own.stop):
            ends = [
                (float(of[0].centres[phase, scan, row, column, number]) + side - centres) / log_scales.exp()
                for side in (-0.1, 0.1)
            ]
            below, above = (1 / (1 + (-end).exp()) for end in ends)
            expected = math.log(float((logits.softmax(0) * (above - below)).sum()) + 1e-3)
            assert float(added[phase, scan, row, column, number]) == pytest.approx(expected, abs=1e-3)
    walls = (of[1].centres.expm1() > 20)[..., own]
    share = [float((mixture.logits.softmax(-1)[..., own] * walls).sum(-1)[pole].mean()) for mixture in of]
    assert share[1] < 0.25 * share[0]


def test_earlier_ranges_of_training_are_partly_the_decoders_own_samples_within_true_masks():
    tokenizer, images = NearestRangeTokenizer(CONFIG, SENSOR).eval(), some_images(8)
    pixels = PixelDecoder(replace(PIXELS, own_context=0.5), SENSOR, tokenizer.num_features, tokenizer.num_components)
    with torch.no_grad():
        decoded = tokenizer.decode(tokenizer.encode(images))
    guide, rng = pixels.guide(decoded, 8), torch.Generator().manual_seed(0)
    known_m = pixels._partly_own(guide, images, rng, rng)
    assert torch.equal(known_m > 0, images.return_mask)
    own = (known_m != images.range_m).flatten(1).float().mean(1) > 0.5
    assert own.tolist() == [True] * 4 + [False] * 4
    uniform = torch.rand((8, 2, *images.range_m.shape[1:]), generator=rng.manual_seed(0))
    nothing = Observed.nothing(SENSOR, 8)
    with torch.no_grad():
        sampled_m = pixels._sample_range(guide, uniform, images.return_mask, nothing, PixelSampling())
    torch.testing.assert_close(known_m[:4], sampled_m[:4])
    plain = PixelDecoder(PIXELS, SENSOR, tokenizer.num_features, tokenizer.num_components)
    plain.load_state_dict(pixels.state_dict())
    with torch.no_grad():
        for training, alike in ((True, False), (False, True)):  # what validation tells is of true neighbours
            nats = [each.train(training).estimate(decoded, images, rng.manual_seed(3))[1] for each in (pixels, plain)]
            assert torch.equal(*nats) is alike


def test_candidates_are_not_weighed_where_nothing_is_decoded_by_which_they_could_be():
    with pytest.raises(ConfigError, match="weighed_components without decoded_components"):
        PixelDecoderConfig(weighed_components=True)


def test_the_mode_of_a_mixture_is_its_densest_centre():
    rng = torch.Generator().manual_seed(0)
    logits, spread = torch.randn(200, 5, generator=rng), torch.rand(200, 5, generator=rng)
    mixture = RangeMixture(logits, 1 + 3 * spread, torch.full((200, 5), -3.0), (1.0, 80.0))
    densities = mixture_density_by_loop(mixture)
    expected = mixture.centres.gather(1, densities.argmax(1, keepdim=True))[:, 0].expm1()
    torch.testing.assert_close(mixture.mode(), expected)


def mixture_density_by_loop(mixture):
    """Return the density of ln(1 + range) at every centre, from the logistic density's own formula."""
    found = torch.zeros(mixture.centres.shape, dtype=torch.float64)
    low, high = (math.log1p(limit) for limit in mixture.limits_m)
    for pixel in range(len(found)):
        weights = mixture.logits[pixel].double().softmax(0)
        for at in range(found.shape[1]):
            for other in range(found.shape[1]):
                centre, scale = float(mixture.centres[pixel, other]), math.exp(float(mixture.log_scales[pixel, other]))
                below, above = (1 / (1 + math.exp(-(limit - centre) / scale)) for limit in (low, high))
                s = 1 / (1 + math.exp(-(float(mixture.centres[pixel, at]) - centre) / scale))
                found[pixel, at] += float(weights[other]) * s * (1 - s) / scale / (above - below)
    return found


@pytest.mark.parametrize(
    ("changes", "got"),
    [
        ({"cell_rows": 0}, "cell_rows=0"),
        ({"part_columns": 3}, "part_columns=3 of cell_columns=2"),
        ({"levels": 1}, "levels=1"),
        ({"cell_rows": 6, "part_rows": 6, "part_columns": 1}, "levels=128 in 6 parts"),
        ({"cell_columns": 4, "part_columns": 4, "part_rows": 4}, "levels=128 in 16 parts"),
    ],
)
def test_sizes_of_which_no_codes_can_be_made_are_refused(changes, got):
    with pytest.raises(ConfigError, match=got):
        NearestRangeConfig(**changes)


def test_cells_that_do_not_divide_the_image_are_refused():
    with pytest.raises(ConfigError, match="cells of 8x24"):
        NearestRangeTokenizer(NearestRangeConfig(cell_columns=24), SENSOR)
