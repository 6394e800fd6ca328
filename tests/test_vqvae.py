"""The VQ-VAE against the reference program, its parameter counts, its losses, its circle."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidargrit.core.errors import ConfigError
from lidargrit.generation.tokenizers.vqvae import Vqvae, VqvaeConfig, reconstruction_loss
from lidargrit.nn.convolution import FoldedUpsample, Upsample
from lidargrit.scans.example import Example
from lidargrit.scans.projection import RangeEncoding
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage, TokenGrid
from reference_weights import seeded_weights

SMALL = VqvaeConfig(channels=32, channel_multipliers=(1, 1), code_dim=8, num_codes=16, dropout=0.0)


def sensor_of(height, width):
    sensor = load_sensor("hdl64e_kitti_odometry")
    return replace(sensor.with_columns(width), elevation_rad=sensor.elevation_rad[:height])


def images_of(sensor, batch=2, seed=0):
    rng = torch.Generator().manual_seed(seed)
    size = (batch, sensor.height, sensor.width)
    return RangeImage.masked(torch.rand(size, generator=rng) * 50 + 1, torch.rand(size, generator=rng) < 0.8, sensor)


@pytest.mark.parametrize(
    ("preset", "parameters", "grid"),
    [("lidargrit_kitti_360", 17_295_618, (8, 128)), ("lidargrit_kitti_odometry", 3_148_418, (16, 64))],
)
def test_published_sizes(preset, parameters, grid):
    from lidargrit.generation.presets import load_preset

    preset = load_preset(preset)
    vqvae = Vqvae(preset.model.tokenizer, preset.data.load_sensor())
    assert sum(p.numel() for p in vqvae.parameters() if p.requires_grad) == parameters
    assert vqvae.grid_size == grid


@pytest.mark.shared
def test_layers_layout_and_numbers_are_the_programs(golden):
    data = golden("vqvae_small")
    theirs = json.loads(str(data["config"]))
    config = VqvaeConfig(
        channels=theirs["ch"],
        channel_multipliers=tuple(theirs["ch_mult"]),
        residual_blocks=theirs["num_res_blocks"],
        code_dim=theirs["embed_dim"],
        num_codes=theirs["n_embed"],
        codebook_loss="reference",
    )
    vqvae = Vqvae(config, sensor_of(*data["x"].shape[2:])).eval()
    weights = {k: v for k, v in seeded_weights(data).items() if not k.startswith("loss.")}
    missing, unexpected = vqvae.load_state_dict(weights, strict=False)
    assert not unexpected
    assert set(missing) == {"quantize.usage", "quantize.code_sums"}  # our own bookkeeping, not weights
    with torch.no_grad():
        z = vqvae.quant_conv(vqvae.encoder(torch.from_numpy(data["x"])))
        assert np.allclose(z.numpy(), data["pre_quant"], atol=1e-4)
        quantised = vqvae.quantize(z)
        assert np.array_equal(quantised.tokens.numpy(), data["indices"])
        assert float(quantised.loss) == pytest.approx(float(data["quant_loss"]), abs=1e-4)
        raw = vqvae.decoder(vqvae.post_quant_conv(quantised.latents))
        assert np.allclose(raw.numpy(), data["decoder_raw"], atol=1e-4)


@pytest.mark.shared
def test_reference_reconstruction_and_raydrop_loss_are_the_programs(golden):
    data = {name: torch.as_tensor(value) for name, value in golden("heads_losses").items()}
    target, recon, mask = data["target"][:, 0], data["recon"][:, 0], data["mask"][:, 0] > 0
    ours = reconstruction_loss(recon, target, mask, torch.ones_like(mask), "reference")
    assert float(ours) == pytest.approx(float(data["loss_rec"]), abs=1e-5)
    bce = torch.nn.functional.binary_cross_entropy_with_logits(data["mask_logits"][:, 0], mask.float())
    assert float(bce) == pytest.approx(float(data["loss_mask"]), abs=1e-5)
    total = ours + 0.1 * bce + float(data["codebook_loss"])
    # The program's total also holds its neighbour-direction term, which the paper does not have.
    assert float(total + data["lambda_nd"] * data["loss_nd"]) == pytest.approx(float(data["loss_total"]), abs=1e-4)


@pytest.mark.shared
def test_heads_and_bernoulli_composition_are_the_programs(golden):
    data = {name: torch.as_tensor(value) for name, value in golden("heads_losses").items()}
    raw = data["decoder_out"]
    encoded = raw[:, :1].tanh()
    assert torch.allclose(encoded, data["depth_orig"], atol=1e-6)
    torch.manual_seed(3)
    sampled = torch.bernoulli(raw[:, 1:].sigmoid())
    assert torch.equal(sampled, data["bernoulli_mask"])
    assert torch.allclose(torch.where(sampled > 0, encoded, -1.0), data["depth_composed"], atol=1e-6)


def test_losses_of_the_paper_by_a_slow_loop():
    rng = torch.Generator().manual_seed(0)
    encoded, target = (torch.rand((2, 3, 4), generator=rng) * 2 - 1 for _ in range(2))
    mask, sampled = (torch.rand((2, 3, 4), generator=rng) < 0.6 for _ in range(2))
    paper = returns = reference = 0.0
    for b in range(2):
        returned = int(mask[b].sum())
        for i in range(3):
            for j in range(4):
                if mask[b, i, j]:
                    error = abs(float(encoded[b, i, j] - target[b, i, j]))
                    paper += error / 12 / 2
                    returns += error / returned / 2
                    composed = float(encoded[b, i, j]) if sampled[b, i, j] else -1.0
                    reference += abs(composed - float(target[b, i, j])) / returned / 2
    for kind, slow in (("paper", paper), ("returns", returns), ("reference", reference)):
        assert float(reconstruction_loss(encoded, target, mask, sampled, kind)) == pytest.approx(slow, rel=1e-5)


@pytest.mark.parametrize("reconstruction", ["paper", "reference", "returns"])
@pytest.mark.parametrize("raydrop_loss", [True, False])
def test_every_objective_is_finite_and_reaches_every_weight(reconstruction, raydrop_loss):
    sensor = sensor_of(16, 32)
    config = replace(SMALL, reconstruction=reconstruction, raydrop_loss=raydrop_loss)
    vqvae = Vqvae(config, sensor).train()
    terms = vqvae(Example(images_of(sensor)), torch.Generator().manual_seed(0))
    terms["loss"].backward()
    assert bool(terms["loss"].isfinite())
    assert ("raydrop" in terms) == raydrop_loss
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in vqvae.parameters())


@pytest.mark.parametrize("range_encoding", ["linear", "log", "inverse"])
@pytest.mark.parametrize("raydrop_loss", [True, False])
def test_errors_in_metres_are_those_of_the_linear_encoding(range_encoding, raydrop_loss):
    sensor = sensor_of(16, 32)
    config = replace(SMALL, range_encoding=range_encoding, error_unit="metres", raydrop_loss=raydrop_loss)
    torch.manual_seed(0)
    vqvae, images = Vqvae(config, sensor).eval(), images_of(sensor)
    linear = RangeEncoding("linear", sensor.range_min_m, sensor.range_max_m)
    with torch.no_grad():
        terms = vqvae(Example(images), torch.Generator())
        decoded_m = vqvae.decode(vqvae.encode(images)).range_m
        encoded = linear.encode(decoded_m, torch.ones_like(images.return_mask))
        error = (encoded - linear.encode(images.range_m, images.return_mask)).abs()
    expected = (error * images.return_mask).mean() if raydrop_loss else error.mean()
    assert float(terms["reconstruction"]) == pytest.approx(float(expected), rel=1e-4)


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_features_are_what_the_last_layer_reads(precision):
    torch.manual_seed(0)
    sensor = sensor_of(16, 32)
    vqvae = Vqvae(replace(SMALL, channel_multipliers=(1, 2)), sensor).eval().for_decoding(precision)
    with torch.no_grad():
        decoded = vqvae.decode(TokenGrid(torch.randint(16, (2, 8, 16)), 16))
        assert decoded.features is not None
        heads = vqvae.decoder.conv_out(decoded.features)
    assert decoded.features.shape == (2, vqvae.num_features, 16, 32)
    assert decoded.features.dtype == torch.float32
    assert torch.equal(decoded.return_logits, heads[:, 1])
    assert torch.equal(decoded.range_m, vqvae.range_encoding.decode(heads[:, 0].tanh()))


def test_batches_are_joined_with_reflectance_only_if_all_have_it():
    sensor = sensor_of(16, 32)
    plain = images_of(sensor, 2)
    shiny = images_of(sensor, 3, seed=1).with_planes(reflectance=torch.rand(3, 16, 32))
    both = RangeImage.cat([plain, shiny])
    assert torch.equal(both.range_m, torch.cat((plain.range_m, shiny.range_m)))
    assert both.reflectance is None
    twice = RangeImage.cat([shiny, shiny[:1]])
    assert twice.reflectance is not None
    assert torch.equal(twice[3].range_m, shiny[0].range_m)
    masked = RangeImage.masked(shiny.range_m + 1, shiny.return_mask, sensor, shiny.planes)
    assert masked.reflectance is not None
    assert float(masked.reflectance[~masked.return_mask].abs().max()) == 0


def test_padding_around_the_circle_commutes_with_turning_the_car():
    torch.manual_seed(0)
    sensor = sensor_of(16, 32)
    images = images_of(sensor)
    turned = RangeImage(images.range_m.roll(8, -1), images.return_mask.roll(8, -1), sensor)
    with torch.no_grad():
        for padding, commutes in (("wrap", True), ("zero", False)):
            vqvae = Vqvae(replace(SMALL, padding=padding), sensor).eval()
            tokens, turned_tokens = vqvae.encode(images).tokens, vqvae.encode(turned).tokens
            decoded = vqvae.decode(TokenGrid(tokens, 16)).range_m
            again = vqvae.decode(TokenGrid(tokens.roll(4, -1), 16)).range_m
            assert torch.allclose(decoded.roll(8, -1), again, atol=1e-3) == commutes
            if commutes:
                assert float((tokens.roll(4, -1) == turned_tokens).float().mean()) > 0.99


@pytest.mark.parametrize("padding", ["zero", "wrap"])
def test_folded_upsampling_is_upsampling(padding):
    torch.manual_seed(0)
    upsample, x = Upsample(6, padding), torch.randn(2, 6, 4, 8)
    with torch.no_grad():
        assert torch.allclose(FoldedUpsample(upsample)(x), upsample(x), atol=1e-5)


@pytest.mark.parametrize("padding", ["zero", "wrap"])
def test_what_only_decodes_decodes_the_same(padding):
    torch.manual_seed(0)
    sensor = sensor_of(16, 32)
    config = replace(SMALL, channel_multipliers=(1, 2, 2), padding=padding)
    vqvae = Vqvae(config, sensor).eval()
    before = {name: weight.clone() for name, weight in vqvae.state_dict().items()}
    tokens = TokenGrid(torch.randint(16, (2, 4, 8)), 16)
    with torch.no_grad():
        plain, exact = vqvae.decode(tokens), vqvae.for_decoding("fp32").decode(tokens)
        short = vqvae.for_decoding("bf16").decode(tokens)
    assert torch.allclose(plain.range_m, exact.range_m, atol=1e-3)
    assert torch.allclose(plain.return_logits, exact.return_logits, atol=1e-4)
    assert 0 < float((plain.range_m - short.range_m).abs().mean()) < 1.5  # ranges of an untrained network
    assert before.keys() == vqvae.state_dict().keys()
    assert all(torch.equal(weight, before[name]) for name, weight in vqvae.state_dict().items())


def test_threshold_and_bernoulli_masks():
    sensor = sensor_of(16, 32)
    vqvae = Vqvae(SMALL, sensor).eval()
    with torch.no_grad():
        tokens = vqvae.encode(images_of(sensor))
        probability = vqvae.decode(tokens).return_logits.sigmoid()
        rngs = [torch.Generator().manual_seed(seed) for seed in (0, 1)]
        sampled = torch.stack([vqvae.sample(tokens, rngs).return_mask for _ in range(120)]).float().mean(0)
        alone = vqvae.sample(TokenGrid(tokens.tokens[1:], 16), [torch.Generator().manual_seed(1)])
        beside = vqvae.sample(tokens, [torch.Generator().manual_seed(seed) for seed in (0, 1)])
        threshold = vqvae.sample(tokens, rngs, "threshold")
    assert torch.equal(threshold.return_mask, probability >= 0.5)
    assert float((sampled - probability).abs().max()) < 0.25  # five standard errors of 120 samples are 0.23
    assert float((sampled - probability).mean()) == pytest.approx(0, abs=0.01)
    assert float((alone.return_mask == beside.return_mask[1:]).float().mean()) > 0.999  # its own random numbers


def test_sizes_that_cannot_be_halved_are_refused():
    with pytest.raises(ConfigError, match=r"16x30; wanted both sizes divisible by 4"):
        Vqvae(replace(SMALL, channel_multipliers=(1, 1, 1)), sensor_of(16, 30))
    with pytest.raises(ConfigError, match="multiple of 32"):
        replace(SMALL, channels=20)


@pytest.mark.parametrize("wrong", [-0.1, float("nan")])
def test_a_negative_weight_of_the_loss_is_refused(wrong):
    with pytest.raises(ConfigError, match=f"raydrop_weight={wrong}; wanted a number, at least 0"):
        VqvaeConfig(raydrop_weight=wrong)


def test_cells_may_have_fewer_columns_than_rows():
    sizes = VqvaeConfig(channels=32, channel_multipliers=(1, 1, 1, 2), cell_columns=2, code_dim=4, dropout=0.0)
    sensor = load_sensor("hdl64e_kitti_odometry").with_columns(32, 1)
    torch.manual_seed(0)
    vqvae = Vqvae(sizes, sensor).eval()
    assert vqvae.grid_size == (8, 16)
    range_m = 5 + 15 * torch.rand((2, 64, 32))
    tokens = vqvae.encode(RangeImage(range_m, range_m > 0, sensor))
    decoded = vqvae.decode(tokens)
    assert decoded.range_m.shape == (2, 64, 32)
    quick = vqvae.for_decoding("fp32").decode(tokens)
    assert torch.allclose(quick.range_m, decoded.range_m, atol=1e-3)
    around = Vqvae(replace(sizes, padding="wrap"), sensor).eval()
    before, after = (
        around.encode(RangeImage(image, image > 0, sensor)).tokens for image in (range_m, range_m.roll(2, 2))
    )
    assert torch.equal(after, before.roll(1, 2)), "a turn by a cell turns the tokens by one"
    for columns in (3, 16):
        with pytest.raises(ConfigError, match=f"cell_columns={columns}; wanted a power of 2 up to the 8 rows"):
            replace(sizes, cell_columns=columns)
