"""LiDM: its networks, codec and sampler against the program's numbers, latents that are kept, its checkpoints."""

import json
import math
from dataclasses import replace

import pytest
import torch

import lidargrit
from lidargrit.cli import main
from lidargrit.core.errors import CheckpointError, ConfigError
from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.encoding_cache import EncodingCache
from lidargrit.generation.presets import load_preset
from lidargrit.generation.settings import Preset, TrainingConfig
from lidargrit.generation.tokenizers.curve_vqvae import (
    CurveVqvae,
    CurveVqvaeConfig,
    decode_range,
    encode_range,
    return_threshold,
)
from lidargrit.generation.tokenizers.vqvae import VqvaeConfig
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage, TokenGrid
from lidargrit.systems.lidargrit.system import LidarGrit
from lidargrit.systems.lidm import latent_diffusion
from lidargrit.systems.lidm.latent_unet import LatentUnet, LatentUnetConfig
from lidargrit.systems.lidm.system import Lidm, LidmConfig, LidmSampling, _latents
from lidargrit.training.taken_stages import taken_stages
from reference_weights import seeded_weights
from tiny_runs import learn

SENSOR = load_sensor("hdl64e_kitti_360").with_columns(32)
LOW = load_sensor("vlp16").with_columns(64)  # 16x64, as the reference numbers
TINY = CurveVqvaeConfig(32, (1, 1, 2, 2), (1, 2, 2), 1, code_dim=4, num_codes=32, mask_head=True)
TINY_UNET = LatentUnetConfig(32, (1, 2, 4), 1, (0, 1, 2), head_channels=16)
SMALL = Lidm.smallest_config(SENSOR)
SETTINGS = {  # of SMALL, by which a preset of another size becomes that
    "model.tokenizer.channels": 32,
    "model.tokenizer.channel_multipliers": [1, 1],
    "model.tokenizer.row_strides": [2],
    "model.tokenizer.residual_blocks": 1,
    "model.tokenizer.code_dim": 4,
    "model.tokenizer.num_codes": 32,
    "model.tokenizer.range_scale": 7.0,
    "model.denoiser.channels": 32,
    "model.denoiser.channel_multipliers": [1, 1],
    "model.denoiser.residual_blocks": 1,
    "model.denoiser.attention_levels": [],
}


def walls(count=2, sensor=SENSOR):
    rng = torch.Generator().manual_seed(0)
    shape = count, sensor.height, sensor.width
    mask = torch.rand(shape, generator=rng) < 0.8
    range_m = torch.where(mask, (2 + 50 * torch.rand(count, 1, sensor.width, generator=rng)).expand(shape), 0)
    return RangeImage(range_m, mask, sensor)


def made(config=SMALL, sensor=SENSOR):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return Lidm(config, sensor).eval()


@pytest.fixture(scope="module")
def numbers(golden):
    return golden("rivals/lidm")


def loaded(network, numbers, part, **besides):
    data = {"layout": numbers[f"{part}_layout"], "weight_seed": numbers[f"{part}_weight_seed"]}
    network.load_state_dict({**besides, **seeded_weights(data)})
    return network.eval().requires_grad_(False)


def autoencoder(numbers, part, config):
    tokenizer = CurveVqvae(config, LOW)
    return loaded(tokenizer, numbers, part, **dict(tokenizer.quantize.named_buffers(prefix="quantize")))


@pytest.fixture(scope="module")
def tiny(numbers):
    return autoencoder(numbers, "ae_tiny", TINY)


@pytest.fixture(scope="module")
def tiny_unet(numbers):
    return loaded(LatentUnet(TINY_UNET, 4, (4, 16)), numbers, "unet_tiny")


def agree(ours, theirs, tolerance=1e-4):
    theirs = torch.as_tensor(theirs)
    assert ours.shape == theirs.shape
    assert float((ours - theirs).abs().max()) <= tolerance * float(theirs.abs().max())


def parameters(module):
    return sum(weight.numel() for weight in module.parameters())


@pytest.mark.parametrize(
    ("name", "latents", "sizes"),
    [
        ("lidm_kitti_360", (8, 16, 128), (15_070_361, 257_751_560)),
        ("lidm_small", (8, 16, 32), (988_122, 1_859_464)),
        ("lidm_small_shared", (4, 16, 64), (806_210, 1_857_156)),
    ],
)
def test_presets_have_the_published_size_or_that_of_two_cores(name, latents, sizes):
    preset = load_preset(name)
    sensor = preset.data.load_sensor()
    with torch.device("meta"):
        generator = Lidm(preset.model, sensor)
    assert generator.latent_shape == latents
    assert (parameters(generator.tokenizer), parameters(generator.denoiser)) == sizes
    assert preset.training.keys() == set(generator.stages)


@pytest.mark.shared
@pytest.mark.parametrize(("kind", "scale"), [("log", 5.84), ("linear", 56.0)])
def test_ranges_are_encoded_and_read_as_the_program_does(kind, scale, numbers):
    config = CurveVqvaeConfig(range_encoding=kind, range_scale=scale)
    range_m, encoded = torch.from_numpy(numbers["codec_metres"]).clamp(min=0), numbers[f"codec_{kind}"][0]
    ours = encode_range(range_m, config)
    reached = torch.from_numpy(encoded) < 1
    agree(ours[reached], encoded[reached], 1e-6)
    beyond = ours[~reached & (range_m > 2**5.84 - 1)]  # the program cuts these to 56 m; here they are no return
    assert len(beyond)
    assert bool((beyond < return_threshold(config)).all())
    assert return_threshold(config) == pytest.approx(float(numbers[f"codec_{kind}_threshold"]), abs=1e-12)
    read_m = decode_range(torch.from_numpy(encoded), config)
    returned = (torch.from_numpy(encoded) >= return_threshold(config)).numpy()
    assert (returned == (numbers[f"codec_{kind}_mask"][0] > 0)).all()
    inside = read_m[(read_m > 1) & (read_m < 56)].double()
    theirs = torch.from_numpy(numbers[f"codec_{kind}_points"]).norm(dim=1)
    agree(inside.sort().values, theirs.sort().values, 1e-6)


@pytest.mark.shared
def test_the_autoencoder_and_its_stages_are_the_programs(numbers, tiny):
    stages = [name.removeprefix("ae_tiny_after_") for name in numbers if name.startswith("ae_tiny_after_")]
    by_name = {name.replace(".", "_"): module for name, module in tiny.named_modules()}
    found = {}
    hooks = [
        by_name[stage].register_forward_hook(lambda _, __, out, stage=stage: found.update({stage: out}))
        for stage in stages
    ]
    latents = tiny.quant_conv(tiny.encoder(torch.from_numpy(numbers["ae_tiny_x"])))
    agree(latents, numbers["ae_tiny_latent"])
    tokens = tiny.quantised(latents)
    assert torch.equal(tokens.tokens.flatten(1), torch.from_numpy(numbers["ae_tiny_codes"]))
    agree(tiny.quantize(latents).loss, numbers["ae_tiny_codebook_loss"])
    raw = tiny.decoder(tiny.post_quant_conv(tiny.quantize.lookup(tokens.tokens)))
    agree(raw, numbers["ae_tiny_raw"])
    for stage in stages:
        agree(found[stage][:1], numbers[f"ae_tiny_after_{stage}"])
    for hook in hooks:
        hook.remove()
    decoded = tiny.decode(tokens)
    theirs = torch.from_numpy(numbers["ae_tiny_decoded"])[:, 0]  # -1 where the mask channel is below 0
    range_m = decode_range(theirs, TINY)
    seen = (theirs > return_threshold(TINY)) & (range_m > LOW.range_min_m) & (range_m < LOW.range_max_m)
    assert torch.equal(decoded.threshold().return_mask, seen)
    agree(decoded.range_m[seen], range_m[seen])


@pytest.mark.shared
def test_the_autoencoder_of_published_width_is_the_programs(numbers):
    wide = autoencoder(numbers, "ae_wide", CurveVqvaeConfig())
    latents = wide.quant_conv(wide.encoder(torch.from_numpy(numbers["ae_wide_x"])))
    agree(latents, numbers["ae_wide_latent"])
    tokens = wide.quantised(latents).tokens
    assert torch.equal(tokens.flatten(1), torch.from_numpy(numbers["ae_wide_codes"]))
    agree(wide.quantize(latents).loss, numbers["ae_wide_codebook_loss"])
    agree(wide.decoder(wide.post_quant_conv(wide.quantize.lookup(tokens))), numbers["ae_wide_raw"])


@pytest.mark.shared
def test_the_loss_is_the_programs_once_its_discriminator_is_off(numbers):
    """At step 2: 0.37 stands for the codebook's loss, the rest is the absolute error."""
    error = (torch.from_numpy(numbers["geo_x"]) - torch.from_numpy(numbers["loss_rec"])).abs().mean()
    assert float(error) + 0.37 == pytest.approx(float(numbers["loss_step2"][0]), rel=1e-6)
    assert float(numbers["loss_step2"][2]) == 0, "the weight of the discriminator"
    with torch.no_grad():
        terms = made().tokenizer(Example(walls()), torch.Generator().manual_seed(0))
    assert float(terms["loss"]) == pytest.approx(float(terms["reconstruction"] + terms["commitment"]))


def test_a_mask_channel_is_learned_beside_the_range():
    tokenizer = CurveVqvae(CurveVqvaeConfig(32, (1, 1), (2,), 1, 4, 32, mask_head=True), SENSOR)
    terms = tokenizer(Example(walls()), torch.Generator().manual_seed(0))
    loss = (terms["reconstruction"] + terms["raydrop"]) / 2 + terms["commitment"]
    assert float(terms["loss"].detach()) == pytest.approx(float(loss.detach()))


@pytest.mark.shared
def test_the_denoiser_and_its_stages_are_the_programs(numbers, tiny_unet):
    stages, found = ("time_embed", "input_blocks.1", "input_blocks.3", "middle_block", "output_blocks.1"), {}
    hooks = [
        tiny_unet.get_submodule(name).register_forward_hook(lambda _, __, out, name=name: found.update({name: out}))
        for name in stages
    ]
    x, step = torch.from_numpy(numbers["unet_tiny_x"]), torch.from_numpy(numbers["unet_tiny_t"])
    agree(tiny_unet(x, step.float()), numbers["unet_tiny_eps"])
    for name in stages:
        agree(found[name][:1], numbers[f"unet_tiny_after_{name.replace('.', '_')}"])
    for hook in hooks:
        hook.remove()


@pytest.mark.shared
def test_the_schedule_is_the_programs(numbers):
    shares = latent_diffusion.signal_shares()
    assert torch.equal(shares, torch.from_numpy(numbers["alphas_cumprod"]))
    for steps in (20, 50):
        chosen = latent_diffusion.ddim_steps(steps)
        assert torch.equal(chosen, torch.from_numpy(numbers[f"ddim{steps}_timesteps"]))
        agree(shares[chosen], numbers[f"ddim{steps}_alphas"], 1e-6)


@pytest.mark.shared
@pytest.mark.parametrize("eta", [0, 1])
def test_ddim_takes_the_programs_steps(eta, numbers, tiny, tiny_unet):
    noise = iter([torch.from_numpy(numbers["ddim_xT"]), *torch.from_numpy(numbers["ddim_noise"])])
    seen = []

    def watched(latents, step):
        seen.append(latents)
        return tiny_unet(latents, step)

    last = latent_diffusion.ddim(watched, lambda: next(noise), 5, float(eta))
    for ours, theirs in zip([*seen, last], numbers[f"ddim5_eta{eta}_states"], strict=True):
        agree(ours, theirs)
    if eta == 0:
        raw = tiny.decoder(tiny.post_quant_conv(tiny.quantize.lookup(tiny.quantised(last).tokens)))
        agree(torch.where(raw[:, 1:] < 0, -1.0, raw[:, :1]), numbers["ddim5_decoded"])


def test_noise_of_no_step_and_steps_without_sense_are_refused():
    for settings in ({"steps": 0}, {"steps": 501}, {"eta": 1.5}, {"eta": math.nan}):
        with pytest.raises(ConfigError, match=next(iter(settings))):
            LidmSampling(**settings)
    with pytest.raises(ConfigError, match=r"latents of 32x16; wanted both sizes divisible by 32"):
        made(LidmConfig(SMALL.tokenizer, LatentUnetConfig(32, (1,) * 6, 1, ())))
    with pytest.raises(ConfigError, match=r"64x10; wanted rows divisible by 4, columns by 8"):
        CurveVqvae(TINY, load_sensor("hdl64e_kitti_360").with_columns(10))


def test_latents_are_computed_once_and_do_not_depend_on_the_batch(monkeypatch):
    tokenizer, images = made().tokenizer, walls(4)
    cache, computed = EncodingCache(tokenizer, _latents, bytes_at_most=3 * 4 * 32 * 16 * 4), []
    encode = tokenizer.latents
    monkeypatch.setattr(tokenizer, "latents", lambda batch: computed.append(len(batch)) or encode(batch))
    together = cache(images)
    assert computed == [1, 1, 1, 1]
    assert torch.equal(cache(images[2:3]), together[2:3])
    assert len(computed) == 4
    assert torch.equal(cache(images[[3, 0]]), together[[3, 0]])
    assert len(computed) == 5, "the bound has room for three; the fourth is computed anew"
    assert torch.equal(EncodingCache(tokenizer, _latents)(images[[1, 3]]), together[[1, 3]])
    other = RangeImage(images.range_m.flip(-1), images.return_mask.flip(-1), SENSOR)
    assert not torch.equal(cache(other[:1]), together[:1]), "an augmented image is another"
    agree(together, encode(images).detach())


def test_shared_latents_are_scaled_and_come_back_as_tokens():
    config = LidmConfig(VqvaeConfig(32, (1, 1, 1), code_dim=8, num_codes=32), SMALL.denoiser, scale_latents=True)
    generator, images = made(config), walls()
    with torch.no_grad():
        generator.tokenizer.quantize.embedding.weight.normal_(0.3, 5.0, generator=torch.Generator().manual_seed(1))
    objective = generator.objective("denoiser")
    spread = float(generator.tokenizer.quantize.embedding.weight.detach().std(correction=0))
    assert float(objective.latent_scale) == pytest.approx(spread, rel=1e-5)
    with torch.no_grad():
        terms = objective(Example(images), torch.Generator().manual_seed(0))
    latents = generator.tokenizer.latents(images)
    assert float(terms["latent_std"]) == pytest.approx(float(latents.std().detach()) / spread, rel=1e-4)
    fresh = made(config)
    fresh.load_stage("tokenizer", generator.tokenizer)
    assert float(generator.latent_scale) == 1, "asking for an objective changes nothing"
    for each in (fresh, generator):
        each.load_stage("denoiser", objective)
        assert torch.equal(each.latent_scale, objective.latent_scale)
    assert torch.equal(fresh.sample([3]).range_m, generator.sample([3]).range_m)
    tokens = generator.tokenizer.encode(images)
    assert torch.equal(
        generator.tokenizer.quantised(generator.tokenizer.quantize.lookup(tokens.tokens)).tokens, tokens.tokens
    )
    assert isinstance(tokens, TokenGrid)


def test_the_tokenizer_of_a_lidargrit_is_taken_as_it_is(tmp_path):
    theirs = LidarGrit(LidarGrit.smallest_config(SENSOR), SENSOR)
    theirs.save(tmp_path)
    model = LidmConfig(theirs.config.tokenizer, LatentUnetConfig(32, (1,), 1, ()), scale_latents=True)
    fit = TrainingConfig(scans=2, batch_size=2, learning_rate=1e-3, start=f"frozen:{tmp_path}")
    preset, generator = Preset("shared", "lidm", model, DataConfig(), {"tokenizer": fit}), made(model)
    taken = taken_stages(preset, generator)
    assert taken.keys() == {"tokenizer"}
    generator.load_stage("tokenizer", taken["tokenizer"])
    weights = theirs.tokenizer.state_dict()
    assert all(torch.equal(weights[name], of) for name, of in generator.tokenizer.state_dict().items())
    with pytest.raises(ConfigError, match=r"whose tokenizer is another \(model\.tokenizer\.\w+="):
        taken_stages(replace(preset, model=SMALL), made())


def test_noise_in_latents_is_learned():
    steps = learn(made().objective("denoiser").train(), walls(), range(12), 5e-3)
    losses = [terms["loss"] for terms in steps]
    assert losses[0] == pytest.approx(1, abs=0.1), "a network that begins at zero leaves all the noise"
    assert sum(losses[-4:]) / 4 < 0.8


def checkpoint(mask_head=False, averaged=True):
    """Return what the program saves, with seeded weights of the smallest networks."""
    tokenizer = CurveVqvae(CurveVqvaeConfig(32, (1, 1), (2,), 1, 4, 32, range_scale=7.0, mask_head=mask_head), SENSOR)
    rng = torch.Generator().manual_seed(5)
    first = {name: torch.randn(of.shape, generator=rng) for name, of in tokenizer.named_parameters()}
    second = {name: torch.randn(of.shape, generator=rng) for name, of in made().denoiser.state_dict().items()}
    state = {f"first_stage_model.{name}": of for name, of in first.items()}
    state |= {f"model.diffusion_model.{name}": torch.zeros_like(of) if averaged else of for name, of in second.items()}
    if averaged:
        state |= {f"model_ema.diffusion_model{name.replace('.', '')}": of for name, of in second.items()}
        state |= {"model_ema.decay": torch.tensor(0.9999), "model_ema.num_updates": torch.tensor(7, dtype=torch.int)}
    state |= {"first_stage_model.loss.discriminator.main.0.weight": torch.ones(2), "logvar": torch.zeros(1000)}
    state |= {"betas": torch.ones(1000), "first_stage_model.loss.logvar": torch.tensor(3)}
    return {"epoch": 3, "global_step": 9, "state_dict": state}, first, second


@pytest.mark.parametrize(("mask_head", "averaged"), [(False, True), (True, False)])
def test_a_checkpoint_of_the_program_becomes_a_run(mask_head, averaged, tmp_path):
    saved, first, second = checkpoint(mask_head, averaged)
    path, out = tmp_path / "lidm.ckpt", tmp_path / "run"
    torch.save(saved, path)
    words = ["data.columns=32", *(f"{name}={json.dumps(value)}" for name, value in SETTINGS.items())]
    assert main(["import-weights", "lidm_kitti_360", str(out), str(path), "--set", *words]) == 0
    generator = lidargrit.load(out)
    assert generator.config.tokenizer.mask_head == mask_head
    for module, wanted in ((generator.tokenizer, first), (generator.denoiser, second)):
        weights = dict(module.named_parameters())
        assert weights.keys() == wanted.keys()
        assert all(torch.equal(weights[name], of) for name, of in wanted.items())
    assert float(generator.latent_scale) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.pop("first_stage_model.decoder.conv_out.weight"), "holds no decoder of a tokenizer 'curve_vqvae'"),
        (lambda s: s.pop("first_stage_model.quant_conv.bias"), r"lacks 'quant_conv\.bias'"),
        (lambda s: s.pop("model_ema.diffusion_modelout2bias"), r"lacks 'out\.2\.bias'"),
        (lambda s: s.update({"model_ema.diffusion_modelmore": torch.ones(1)}), "has besides 'diffusion_modelmore'"),
        (lambda s: s.update({"first_stage_model.quant_conv.bias": torch.ones(5)}), r"'quant_conv\.bias' 5 in place of"),
        (lambda s: s.update({"betas": torch.ones(3).half()}), "'betas' is no float32 tensor"),
    ],
)
def test_checkpoints_of_another_form_are_refused(change, message, tmp_path):
    saved, path = checkpoint()[0], tmp_path / "lidm.ckpt"
    change(saved["state_dict"])
    torch.save(saved, path)
    with pytest.raises(CheckpointError, match=message):
        Lidm.from_published([path], SMALL, SENSOR)
