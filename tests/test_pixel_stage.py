"""The pixel decoder as a third stage: trained over a frozen tokenizer, sampled by default, scored in bits."""

import copy
import json
import math
import pickle
import re
from functools import partial

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import ConfigError
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import load_range_images
from lidargrit.evaluation.intervals import Estimate
from lidargrit.evaluation.likelihood import _maps
from lidargrit.evaluation.reconstruction import score_reconstruction
from lidargrit.generation.batches import in_batches
from lidargrit.generation.generator import load
from lidargrit.generation.pixel_decoder.phase_network import PixelDecoderConfig
from lidargrit.generation.range_steps import RangeSteps
from lidargrit.generation.settings import Preset, TrainingConfig
from lidargrit.generation.tokenizers.vqvae import VqvaeConfig
from lidargrit.nn.decoding import CachedDecoder
from lidargrit.nn.transformer import TransformerConfig
from lidargrit.scans.condition import Observed
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.systems.lidargrit import system as lidargrit
from lidargrit.systems.lidargrit.system import (
    START_TOKEN,
    LidarGrit,
    LidarGritConfig,
    TokenSampling,
    after_start,
    sample_token,
)
from lidargrit.systems.maskgit.system import MaskedSampling, MaskGit, MaskGitConfig
from lidargrit.training import train
from tiny_runs import with_random_weights

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(512, stride=8)  # 64x64 pixels
TOKENIZER = VqvaeConfig(
    channels=32, channel_multipliers=(1, 1, 1, 1), code_dim=4, num_codes=8, dropout=0.0, padding="wrap"
)
TRANSFORMER = TransformerConfig(layers=1, heads=2, width=16)
PIXELS = PixelDecoderConfig(mask_features=2, range_features=2, mask_width=4, range_width=4, blocks=1)


def made(pixels: PixelDecoderConfig | None = PIXELS) -> LidarGrit:
    generator = LidarGrit(LidarGritConfig(TOKENIZER, TRANSFORMER, pixels), SENSOR).eval()
    for stage in generator.stages:  # the same weights with and without a pixel decoder, whose own begin at zero
        with_random_weights(generator.get_submodule(stage))
    return generator


def scans(count: int) -> RangeImage:
    rng = torch.Generator().manual_seed(1)
    size = (count, SENSOR.height, SENSOR.width)
    return RangeImage.masked(2 + 40 * torch.rand(size, generator=rng), torch.rand(size, generator=rng) < 0.8, SENSOR)


def preset_of(pixels: PixelDecoderConfig | None) -> Preset:
    fit = TrainingConfig(scans=4, batch_size=2, learning_rate=1e-3, validation_scans=1)
    stages = ("tokenizer", "transformer") if pixels is None else ("tokenizer", "transformer", "pixels")
    return Preset(
        "a test",
        "lidargrit",
        LidarGritConfig(TOKENIZER, TRANSFORMER, pixels),
        DataConfig(train=("simulated:4:train",), val=("simulated:1:val",), columns=512, column_stride=8),
        dict.fromkeys(stages, fit),
    )


def test_the_third_stage_is_there_where_the_configuration_has_one():
    assert made().stages == ("tokenizer", "transformer", "pixels")
    assert made(None).stages == ("tokenizer", "transformer")


def test_the_pixel_decoder_is_what_samples_unless_told_otherwise():
    generator, plain = made(), made(None)
    by_pixels = generator.sample([0, 1])
    assert torch.equal(by_pixels.range_m, generator.sample([0, 1], sampling=TokenSampling(mask="pixels")).range_m)
    before = generator.sample([0, 1], sampling=TokenSampling(mask="bernoulli"))
    assert torch.equal(before.range_m, plain.sample([0, 1]).range_m)
    assert not torch.equal(by_pixels.return_mask, before.return_mask)
    both = by_pixels.return_mask & before.return_mask
    assert not torch.equal(by_pixels.range_m[both], before.range_m[both])


def test_a_seed_gives_the_same_scan_whatever_its_batch():
    generator = made()
    assert torch.equal(generator.sample([0, 1, 2, 3, 4, 5]).range_m[4], generator.sample([4]).range_m[0])


def test_after_sampling_it_can_still_be_pickled():
    generator = made()
    again = pickle.loads(pickle.dumps(generator))
    wanted = generator.sample([1])
    assert torch.equal(pickle.loads(pickle.dumps(generator)).sample([1]).range_m, wanted.range_m)
    assert torch.equal(again.sample([1]).range_m, wanted.range_m)


def test_what_was_prepared_for_sampling_is_kept_for_other_choices_of_pixels(monkeypatch):
    generator = made()
    generator.sample([0])
    monkeypatch.setattr(lidargrit, "CachedDecoder", None)
    generator.sample([0], sampling=TokenSampling(range_noise=0.5, mask_correlation=0.0))
    with pytest.raises(TypeError):
        generator.sample([0], sampling=TokenSampling(temperature=0.5))


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_after_any_change_of_weights_it_samples_as_a_fresh_one_does(precision):
    generator, sampling = made(), TokenSampling(weights=precision, decoder=precision)
    generator.sample([0], sampling=sampling)
    with torch.no_grad():
        for weight in generator.parameters():
            weight.data.mul_(-3)  # which changes neither the address nor the version
    fresh = copy.deepcopy(generator)
    fresh._decoder_cache = None
    assert torch.equal(generator.sample([0], sampling=sampling).range_m, fresh.sample([0], sampling=sampling).range_m)


@pytest.mark.parametrize("kind", [LidarGrit, MaskGit])
def test_a_choice_that_cannot_be_is_refused_before_any_token(kind, monkeypatch):
    generator = kind(kind.Config(TOKENIZER, TRANSFORMER), SENSOR).eval()
    monkeypatch.setattr(generator, "transformer", None)
    with pytest.raises(ConfigError, match="without a pixel decoder"):
        generator.sample([0], sampling=generator.Sampling(mask="pixels"))


def test_a_model_without_a_pixel_decoder_refuses_to_sample_by_one():
    with pytest.raises(ConfigError, match="without a pixel decoder"):
        made(None).sample([0], sampling=TokenSampling(mask="pixels"))
    with pytest.raises(ConfigError, match="range_noise=0"):
        TokenSampling(range_noise=0.0)


@pytest.mark.parametrize("kind", [LidarGrit, MaskGit])
def test_settings_of_a_pixel_decoder_that_samples_nothing_are_refused(kind):
    without = kind(kind.Config(TOKENIZER, TRANSFORMER), SENSOR).eval()
    for changed in ({"range_noise": 0.5}, {"range_temperature": 0.5}, {"mask_correlation": 0.0}):
        name, value = next(iter(changed.items()))
        with pytest.raises(
            ConfigError, match=rf"^got {name}={value}, .* for a model without one; wanted settings that"
        ):
            without.sample([0], sampling=kind.Sampling(**changed))
    without.check_choice("auto", kind.Sampling(decoder="bf16").pixels())
    for mask in ("bernoulli", "threshold"):
        with pytest.raises(ConfigError, match=rf"for mask={mask}; wanted .*; leave it out, or take mask=pixels"):
            made().sample([0], sampling=TokenSampling(mask=mask, range_noise=0.5))


def test_a_noise_beyond_all_numbers_is_refused():
    with pytest.raises(ConfigError, match=r"range_noise=1e\+39; wanted a number, above 0, at most 1e\+06; "):
        TokenSampling(range_noise=1e39)


def test_maskgit_takes_a_pixel_decoder_too():
    torch.manual_seed(0)
    generator = MaskGit(MaskGitConfig(TOKENIZER, TRANSFORMER, PIXELS), SENSOR).eval()
    assert generator.stages == ("tokenizer", "transformer", "pixels")
    by_pixels = generator.sample([3, 4], sampling=MaskedSampling(steps=2))
    assert torch.equal(by_pixels.range_m[1], generator.sample([4], sampling=MaskedSampling(steps=2)).range_m[0])
    assert generator.cost().flops > generator.cost(MaskedSampling(mask="bernoulli")).flops


def test_the_bits_are_those_of_tokens_mask_and_ranges():
    generator, images = made(), scans(3)
    bits, alone = generator.bits(images), made(None).bits(images)
    assert bits.is_whole
    assert not alone.is_whole
    assert set(alone.per_scan()) == {"tokens"}
    assert torch.equal(alone.tokens, bits.tokens)
    assert bits.range is not None
    assert bits.mask is not None
    assert bool((bits.range[~images.return_mask] == 0).all())
    assert torch.allclose(bits.total(), torch.stack([*bits.per_scan().values()]).sum(0))
    assert torch.allclose(bits.per_pixel().double().sum((1, 2)), bits.total(), rtol=1e-5)
    # A step is nearly as likely as its width times the density, where it is narrower than every component.
    steps = RangeSteps(SENSOR, 1)
    rounded = steps.round(images)
    assert generator.pixels is not None
    density = generator.pixels(generator.tokenizer.decode(generator.tokenizer.encode(rounded)), rounded).range
    expected = (density.sum() / math.log(2) - math.log2(0.001) * images.return_mask.sum()).item()
    assert float(generator.bits(images, 1).per_scan()["range"].sum()) == pytest.approx(expected, rel=2e-3)


def test_anomaly_is_what_exceeds_the_expected_bits(tmp_path, capsys):
    generator, images = made(), scans(2)
    bits = generator.bits(images, expected=True)
    assert bits.mask is not None
    assert bits.range is not None
    assert bits.expected is not None
    assert torch.allclose(bits.anomaly(), bits.mask + bits.range - bits.expected)
    dropped = ~images.return_mask
    assert bool((bits.expected[dropped] <= 1.0001).all())  # of a mask alone, at most one bit
    for lacking in (generator.bits(images), made(None).bits(images, expected=True)):
        with pytest.raises(ConfigError, match="got bits without those that were expected"):
            lacking.anomaly()
    generator.save(tmp_path / "run")
    words = ["view", "simulated:1:test", "--color", "anomaly", "--model", str(tmp_path / "run"), "-n", "1"]
    assert main([*words, "-o", str(tmp_path / "anomaly.png")]) == 0
    assert (tmp_path / "anomaly.png").stat().st_size > 10_000
    assert main([*words, "-o", str(tmp_path / "anomaly.html")]) == 0
    assert '"anomaly": "' in (tmp_path / "anomaly.html").read_text()
    capsys.readouterr()
    assert main([*words, "-o", str(tmp_path / "other.png"), "--sensor", "vlp16"]) == 2
    assert "first: lidargrit rescan SCANS SEEN --sensor vlp16 --to " in capsys.readouterr().err


def test_maskgit_counts_every_token_alike():
    generator = MaskGit(MaskGitConfig(TOKENIZER, TRANSFORMER, PIXELS), SENSOR).eval()
    bits = generator.bits(scans(1))
    assert bits.is_whole
    assert float(bits.tokens.sum()) == 64 * 3  # 8 codes


def test_a_scan_is_completed_from_the_tokens_and_pixels_that_were_observed():
    generator, images = made(), scans(2)
    observed = torch.zeros_like(images.return_mask)
    observed[:, :, :24] = True  # three columns of tokens
    known = Observed.of_pixels(images, observed)
    tokens = generator.observed_tokens(known).view(2, 8, 8)
    assert bool((tokens[:, :, :3] >= 0).all())
    assert bool((tokens[:, :, 3:] == -1).all())
    completed = generator.complete(known, [5, 6])
    assert torch.equal(completed.range_m[observed], images.range_m[observed])
    assert torch.equal(completed.return_mask[observed], images.return_mask[observed])
    assert not torch.equal(completed.range_m, generator.complete(known, [7, 8]).range_m)
    assert torch.equal(completed.range_m[1], generator.complete(known[1:], [6]).range_m[0])
    whole = Observed.of_pixels(images, torch.ones_like(observed))
    assert torch.equal(generator.observed_tokens(whole), generator.tokenizer.encode(images).tokens.flatten(1))
    assert torch.equal(generator.complete(whole, [5, 6]).range_m, images.range_m)


def test_returns_are_sampled_where_only_the_ranges_of_surfaces_are_known():
    generator, images = made(), scans(2)
    clean = Observed.of_surfaces(images)
    assert generator.conditions == {"pixels", "surfaces"}
    dropped = generator.complete(clean, [5, 6])
    assert not bool((dropped.return_mask & ~images.return_mask).any())
    assert 0 < int(dropped.return_mask.sum()) < int(images.return_mask.sum())
    assert torch.equal(dropped.range_m, images.range_m * dropped.return_mask)
    assert not torch.equal(dropped.return_mask, generator.complete(clean, [7, 8]).return_mask)
    assert torch.equal(dropped.range_m[1], generator.complete(clean[1:], [6]).range_m[0])


def test_two_images_of_one_seed_are_completed_each_by_itself():
    generator, images = made(), scans(2)
    observed = torch.zeros_like(images.return_mask)
    observed[:, ::4] = True
    known = Observed.of_pixels(images, observed)
    completed = generator.complete(known, [5, 5])
    assert torch.equal(completed.range_m[observed], images.range_m[observed])
    assert torch.equal(completed.range_m[1], generator.complete(known[1:], [5]).range_m[0])


@pytest.mark.parametrize("static", [False, True])
def test_observed_tokens_stand_and_later_ones_know_of_them(static):
    generator = made(None)
    decoder = CachedDecoder(
        generator.transformer, 2, partial(sample_token, sampling=TokenSampling()), START_TOKEN, static=static
    )
    uniform = torch.rand(2, 64, generator=torch.Generator().manual_seed(0))
    observed = torch.full((2, 64), -1)
    observed[:, 10:20] = 3
    free, held = decoder.generate(uniform), decoder.generate(uniform, observed)
    assert torch.equal(held[:, :10], free[:, :10])
    assert bool((held[:, 10:20] == 3).all())
    # What follows is likely as after these tokens, not as after the free ones.
    after = generator.transformer(after_start(held[:, :-1]))[:, 20]
    assert torch.equal(held[:, 20], sample_token(after, uniform[:, 20], TokenSampling()))
    assert torch.equal(decoder.generate(uniform), free)


def test_its_cost_counts_every_phase():
    generator = made()
    cost, before = generator.cost(), generator.cost(TokenSampling(mask="threshold"))
    assert cost.network_evaluations == before.network_evaluations + 20
    assert cost.flops > before.flops == made(None).cost().flops
    assert made(None).cost().network_evaluations == math.prod(generator.tokenizer.grid_size) + 1


def test_all_of_it_is_trained_saved_and_read_again(tmp_path):
    trained = train(preset_of(PIXELS), tmp_path / "run")
    log = [json.loads(line) for line in (tmp_path / "run" / "pixels" / "log.jsonl").read_text().splitlines()]
    assert {"loss", "mask_bits", "range_bits"} <= set(log[-1])
    again = load(tmp_path / "run")
    assert torch.equal(trained.sample([5]).range_m, again.sample([5]).range_m)


def test_the_likelihood_of_a_source_is_told_and_its_map_written(tmp_path, capsys):
    made().save(tmp_path / "run")
    words = ["likelihood", "simulated:2:test", "--model", str(tmp_path / "run"), "--map", str(tmp_path / "bits.npy")]
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["whole_scan"]
    assert found["num_scans"] == found["reconstruction"]["num_scans"] == 2
    config = DataConfig(train=("simulated:2:test",), columns=512, column_stride=8)
    images = load_range_images(config.train, config)
    bits = made().bits(images.batch([0, 1])).per_scan()["mask"] / (64 * 64)
    assert found["bits"]["mask"]["pixel"]["value"] == pytest.approx(float(bits.mean()), rel=1e-5)
    errors = score_reconstruction(made().get_tokenizer(), images)
    assert found["reconstruction"]["range_mae_m"] == pytest.approx(errors.range_mae_m, rel=1e-3)
    of_scans = [sum(scan[part] for part in ("tokens", "mask", "range")) for scan in found["scans"]]
    assert found["bits"]["all"]["scan"]["value"] == pytest.approx(sum(of_scans) / 2)
    returns = sum(scan["returns"] for scan in found["scans"])
    assert found["bits"]["range"]["return"]["value"] == pytest.approx(
        sum(scan["range"] for scan in found["scans"]) / returns
    )
    pixels = np.load(tmp_path / "bits.npy")
    assert pixels.shape == (2, 64, 64)
    assert pixels.sum((1, 2)) == pytest.approx(of_scans, rel=1e-5)
    assert main(words) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main([*words[:4], "--step-mm", "0"]) == 2
    assert "got --step-mm 0; wanted a whole number from 1 to 1,000" in capsys.readouterr().err


def test_compare_tells_the_bits_of_whole_scans_where_a_system_has_them(tmp_path, capsys):
    made().save(tmp_path / "with_pixels")
    made(None).save(tmp_path / "tokens_alone")
    systems = [str(tmp_path / "with_pixels"), str(tmp_path / "tokens_alone")]
    words = ["compare", str(tmp_path / "table"), *systems, "--reference", "simulated:2:test", "-n", "2"]
    words += ["--metrics", "bev_jsd"]
    assert main([*words, "--json"]) == 0
    with_pixels, tokens_alone = (cell["costs"] for cell in json.loads(capsys.readouterr().out))
    config = DataConfig(train=("simulated:2:test",), val=("simulated:2:test",), columns=512, column_stride=8)
    expected = made().bits(load_range_images(config.train, config).batch([0, 1]))
    by_hand = sum(float(bits.double().sum()) for bits in (expected.tokens, expected.mask, expected.range))
    assert with_pixels["bits_per_return"] == pytest.approx(by_hand / int(expected.return_mask.sum()), rel=1e-6)
    assert tokens_alone["bits_per_return"] is None
    assert main(words) == 0
    table = capsys.readouterr().out
    assert re.search(rf"with_pixels .* {with_pixels['bits_per_return']:.4g}\n", table)
    assert re.search(r"tokens_alone .* -\n", table)


def test_a_map_takes_room_on_the_disk_only_as_it_is_written(tmp_path):
    with _maps(tmp_path / "bits.npy", (3, 2, 4)) as file:  # a hole in the file, on a disk that is full, ends a process
        (unfinished,) = tmp_path.rglob("*.partial")
        assert unfinished.stat().st_size < 96
        file.write(np.arange(24, dtype="<f4").tobytes())
    assert np.load(tmp_path / "bits.npy").tolist() == np.arange(24.0).reshape(3, 2, 4).tolist()


def test_the_interval_of_a_ratio_holds_what_other_scans_would_give():
    rng = np.random.default_rng(0)
    inside = 0
    for _ in range(200):
        returns = rng.integers(50, 150, 64)
        found = Estimate.of_ratio((5 * returns + rng.normal(0, 40, 64)).tolist(), returns.astype(float).tolist())
        inside += found.low < 5 < found.high
    assert 180 <= inside <= 199  # of 200 intervals of 95 %


def test_simulated_scans_have_a_finite_likelihood():
    config = DataConfig(train=("simulated:1:test",), val=("simulated:1:test",), columns=512, column_stride=8)
    images = load_range_images(config.train, config).batch([0])
    assert bool(made().bits(images).total().isfinite().all())


def test_the_last_batch_is_filled_up_with_copies():
    """A generator learns how many scans are wanted, so that it need not decode the copies."""
    taken = []

    def compute(indices, seeds):
        taken.append((indices, list(seeds), seeds.num_asked_for))
        range_m = torch.tensor(seeds, dtype=torch.float32)[: seeds.num_asked_for, None, None].expand(-1, 64, 64)
        return RangeImage(range_m, range_m > 0, SENSOR)

    images = in_batches([7, 8, 9, 5, 6], 3, compute)
    assert taken == [([0, 1, 2], [7, 8, 9], 3), ([3, 4, 4], [5, 6, 6], 2)]
    assert images.range_m[:, 0, 0].tolist() == [7, 8, 9, 5, 6]
