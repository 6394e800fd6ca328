"""The forecaster: what the past tells a pixel decoder, how training wears it out, and bits given a past."""

import functools
import math
from dataclasses import replace

import pytest
import torch

from lidargrit.core.errors import ConfigError
from lidargrit.generation.generator import load_class
from lidargrit.generation.pixel_decoder.pixel_decoder import PixelSampling
from lidargrit.scans.example import Example
from lidargrit.scans.fine_columns import in_fine_columns
from lidargrit.scans.past import Past
from lidargrit.scans.sensors import SensorModel, column_azimuths_rad
from lidargrit.scans.types import TYPICAL_LOG_RANGE, RangeImage
from lidargrit.scans.warp import warp
from lidargrit.systems.forecaster.network import COMPONENTS
from lidargrit.systems.forecaster.own_past import with_own
from lidargrit.systems.forecaster.system import Forecaster
from lidargrit.systems.forecaster.worn_past import jittered, worn
from test_lidargan import images_of

STRIDE = 4
ELEVATION_RAD = torch.linspace(0.03, -0.3, 32)[:, None]
SENSOR = SensorModel("small", ELEVATION_RAD, column_azimuths_rad(128, STRIDE), 1.0, 60.0, "spherical", STRIDE)


def street(batch: int) -> torch.Tensor:
    """Return ranges in all fine columns: walls of several distances over level ground, with holes."""
    rng = torch.Generator().manual_seed(1)
    walls_m = 8 + 20 * torch.rand(batch, 1, 16, generator=rng).repeat_interleave(8, -1)
    ground_m = 1.7 / (-ELEVATION_RAD.sin()).clamp(min=1e-3)
    range_m = torch.minimum(walls_m, ground_m) + 0.02 * torch.randn(batch, 32, 128, generator=rng)
    return range_m * (torch.rand(range_m.shape, generator=rng) < 0.9)


def standing(batch: int, scans: int = 2) -> tuple[RangeImage, Past]:
    """Return scans of a car that stands still, and as their past the same surfaces measured with other noise."""
    fine_m = street(batch)
    rng = torch.Generator().manual_seed(2)
    noise_m = 0.02 * torch.randn(batch, scans, 32, 128, generator=rng)
    past_m = torch.where(fine_m[:, None] > 0, fine_m[:, None] + noise_m, 0.0)
    still = torch.eye(4, dtype=torch.float64).expand(batch, scans, 4, 4)
    ages_s = torch.arange(scans, 0, -1).double().expand(batch, scans) / 10
    kept_m = fine_m[..., ::STRIDE].contiguous()
    return RangeImage(kept_m, kept_m > 0, SENSOR), Past(past_m, still, ages_s, SENSOR)


@functools.cache
def forecaster() -> Forecaster:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return Forecaster(Forecaster.smallest_config(SENSOR), SENSOR).eval()


def test_the_past_tells_ranges_where_it_has_returns_and_none_elsewhere():
    _, past = standing(2)
    half = replace(past, range_m=torch.cat((past.range_m[..., :64], torch.zeros(2, 2, 32, 64)), -1))
    decoded, warped = forecaster().told(half, 2), warp(half)
    assert torch.equal(decoded.range_m, warped.surface.range_m.float())
    assert not bool(decoded.range_m[..., 17:].any())
    assert decoded.components is not None
    logits, centres, _ = decoded.components.unbind(1)
    layers_m = torch.stack((warped.surface.range_m, warped.aligned.range_m, warped.last.range_m), 1)
    there = layers_m > 0
    assert bool((logits[~there] < logits[there].min() - 5).all())
    torch.testing.assert_close(centres[there], layers_m[there].log1p().float())
    assert bool((centres[..., 17:] == TYPICAL_LOG_RANGE).all())
    assert not bool(forecaster().told(Past.nothing(SENSOR, 1, 2), 1).range_m.any())


def test_where_the_past_tells_nothing_the_neighbours_tell_what_to_expect():
    images, past = standing(1)
    gone = replace(past, range_m=past.range_m * (torch.arange(128) < 64))
    network = forecaster().pixels.range
    guide = forecaster().pixels.guide(forecaster().told(gone, 1), 1)
    assert guide.told is not None
    mask, v = images.return_mask, images.range_m.log1p()
    for phase in network.phases[1:]:
        expected = network.candidates([phase], guide, mask, v)[0, 0, -1]
        rows, columns = (range(32)[phase.pixels[0]], range(32)[phase.pixels[1]])
        for i, row in enumerate(rows):
            for j, column in enumerate(columns):
                wanted = float(guide.v[0, row, column])
                if not guide.told[0, row, column]:
                    near = [
                        (row + down * phase.lattice.rows, (column + right * phase.lattice.columns) % 32)
                        for down, right in phase.neighbours
                    ]
                    known = [float(v[0][at]) for at in near if 0 <= at[0] < 32 and mask[0][at]]
                    wanted = sum(known) / len(known) if known else wanted
                assert float(expected[i, j]) == pytest.approx(wanted, abs=1e-5)


def test_a_past_saves_bits_and_each_scan_has_its_own():
    """Even before training: the components that begin at past ranges have a head start."""
    images, past = standing(2)
    alone, given = forecaster().bits(images), forecaster().bits(images, condition=past)
    assert bool((given.total() < 0.8 * alone.total()).all())
    assert torch.equal(forecaster().bits(images[1:], condition=past[1:]).total(), given.total()[1:])
    without = forecaster().bits(images, condition=Past.nothing(SENSOR, 2, 3))
    assert torch.equal(without.total(), alone.total())


def test_samples_follow_the_past():
    images, past = standing(1)
    sampled = forecaster().sample([3], past)
    both = sampled.return_mask & images.return_mask
    assert float((sampled.range_m - images.range_m)[both].abs().median()) < 0.2
    assert not torch.equal(sampled.range_m, forecaster().sample([3]).range_m)


def test_conditions_that_do_not_fit_are_refused():
    images, past = standing(2)
    with pytest.raises(ConfigError, match="a Past of 2 scans for 1 images"):
        forecaster().bits(images[:1], condition=past)
    other = SENSOR.with_columns(64, 2)
    with pytest.raises(ConfigError, match="a past by the sensor 'small'"):
        forecaster().sample([1], Past.nothing(replace(other, elevation_rad=ELEVATION_RAD + 0.1), 1, 2))
    multiscale = load_class("multiscale")
    with pytest.raises(ConfigError, match="a condition of type Past for 'multiscale'"):
        multiscale(multiscale.smallest_config(SENSOR), SENSOR).bits(images, condition=past)


def test_a_worn_past_lacks_scans_keeps_rotations_and_is_jittered_alike():
    _, past = standing(64)
    made = worn(past, torch.Generator().manual_seed(0))
    lacking = ~(made.range_m > 0).flatten(2).any(2)
    assert 0.05 < float(lacking.all(1).float().mean()) < 0.35
    assert 0.15 < float(lacking.float().mean()) < 0.45
    turns = made.transforms[..., :3, :3]
    torch.testing.assert_close(turns @ turns.mT, torch.eye(3, dtype=torch.float64).expand_as(turns))
    moved = (made.transforms - past.transforms)[..., :3, 3].norm(dim=-1)
    assert 0.2 < float((moved == 0).float().mean()) < 0.8
    assert float(moved.max()) < 0.15
    kept = made.range_m[..., ::STRIDE]
    assert bool(((kept == past.range_m[..., ::STRIDE]) | lacking[..., None, None]).all())
    warped = warp(past[:8])
    changed = jittered(warped, torch.Generator().manual_seed(1))
    error_m = changed.last.range_m - warped.last.range_m
    seen = warped.last.mask & warped.nearest.mask & (warped.last.range_m > 5)
    torch.testing.assert_close((changed.nearest.range_m - warped.nearest.range_m)[seen], error_m[seen])
    assert torch.equal(changed.surface.range_m > 0, warped.surface.range_m > 0)
    assert 0.005 < float(error_m[seen].std()) < 0.15


def test_a_past_may_end_with_own_samples_each_given_those_before():
    _, past = standing(8, scans=4)
    past.range_m[0, 0] = 0  # a scan that lacks
    past.ages_s[0, 0] = 0
    seen = list[tuple[int, list[float]]]()

    def sample(given: Past, seeds: list[int]) -> RangeImage:
        there = (given.range_m > 0).flatten(2).any(2)[0]
        seen.append((int(there.sum()), given.ages_s[0].tolist()))
        latest_m = given.range_m[:, -1, :, ::STRIDE] + 1.0
        return RangeImage.masked(latest_m, latest_m > 1, SENSOR)

    made = with_own(past, 1.0, sample, torch.Generator().manual_seed(0))
    own = (made.range_m != past.range_m).flatten(2).any(2)
    assert not bool(own[:, 0].any())
    assert not bool(own[0, 1])  # the first that is there
    assert bool(own[1:, -1].all())
    assert bool((own[:, 1:] >= own[:, :-1]).all())  # at the end
    for scan in range(1, 4):  # each is a metre farther than the one that it was given last
        before_m, now_m = made.range_m[1:, scan - 1, :, ::STRIDE], made.range_m[1:, scan, :, ::STRIDE]
        torch.testing.assert_close(now_m[own[1:, scan]], (before_m + 1)[own[1:, scan]] * (before_m > 0)[own[1:, scan]])
    for count, ages_s in seen:  # as of a scan of the drive
        assert ages_s[4 - count :] == pytest.approx([0.1 * step for step in range(count, 0, -1)])
    assert torch.equal(with_own(past, 0.0, sample, torch.Generator()).range_m, past.range_m)


def test_it_knows_rays_that_never_return_and_goes_on_from_a_decoder_behind_a_tokenizer():
    images, past = standing(2)
    images.range_m[:, 30, 5] = images.return_mask[:, 30, 5] = 0
    with torch.random.fork_rng():
        torch.manual_seed(1)
        own = Forecaster(forecaster().config, SENSOR).eval()
        theirs = load_class("lidargrit")
        sizes = replace(forecaster().config.pixels, decoded_components=False, mask_features=3)
        donor = theirs(replace(theirs.smallest_config(SENSOR), pixels=sizes), SENSOR)
        assert donor.pixels is not None
        for weight in donor.pixels.parameters():
            torch.nn.init.normal_(weight, std=0.2)
    own.fit_statistics(images_of(images))
    assert own.past.usual[30, 5] < -2.5 < 2.5 < own.past.usual[images.return_mask.all(0)].min()
    logits = own.told(past, 2).return_logits
    assert bool((logits[:, 30, 5] < -2.5).all())
    taken = own.objective("pixels").weights_from(donor.objective("pixels"))
    missing = own.objective("pixels").load_state_dict(taken, strict=False)
    assert not missing.unexpected_keys
    name = next(name for name in taken if name.startswith("pixels.range.") and name.endswith(".out.0.bias"))
    logits, moved, scales = taken[name].chunk(3)
    for ours, given in zip((logits, moved, scales), donor.objective("pixels").state_dict()[name].chunk(3), strict=True):
        assert torch.equal(ours[:-COMPONENTS], given)
        assert not bool(ours[-COMPONENTS:].any())
    again = own.objective("pixels").weights_from(own.objective("pixels"))
    assert again.keys() | {"past.usual"} == own.objective("pixels").state_dict().keys()


def test_a_point_forecast_leaves_nothing_to_chance_and_is_nearer_than_a_sample():
    images, past = standing(1)
    point = PixelSampling(point=True)
    one, other = (forecaster().sample([seed], past, point) for seed in (1, 2))
    assert torch.equal(one.range_m, other.range_m)

    def error_m(made: RangeImage) -> float:
        both = made.return_mask & images.return_mask
        return float((made.range_m - images.range_m)[both].abs().mean())

    assert error_m(one) < error_m(forecaster().sample([1], past))


def test_columns_between_kept_ones_are_filled_along_surfaces():
    kept_m = torch.tensor([[[10.0, 10.5, 20.0, 0.0]]])
    sensor = replace(SENSOR, elevation_rad=ELEVATION_RAD[:1], azimuth_rad=column_azimuths_rad(16, STRIDE))
    fine_m = in_fine_columns(RangeImage(kept_m, kept_m > 0, sensor))[0, 0].tolist()
    between = [1 / ((1 - share) / 10 + share / 10.5) for share in (0.25, 0.5, 0.75)]
    assert fine_m == pytest.approx([10, *between, 10.5, 10.5, 10.5, 20, 20, 20, 20, 0, 0, 0, 0, 10])


def test_it_learns_from_scans_with_and_without_a_past():
    images, past = standing(2)
    objective = forecaster().objective("pixels").train()
    for example in (Example(images, past), Example(images)):
        terms = objective(example, torch.Generator().manual_seed(3))
        assert math.isfinite(float(terms["loss"].detach()))
        terms["loss"].backward()
    weight = forecaster().past.logit.weight
    assert weight.grad is not None
    assert bool(weight.grad.any())
    forecaster().zero_grad()
    forecaster().eval()
